"""The documentation says what the code says."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib

import pytest
from conftest import ROOT
from typer.main import get_command

from thermofusion.cli import app
from thermofusion.files.shipped import data_dir
from thermofusion.recipe import Recipe, key_reference, load_recipe

PROSE = ("as", "at", "implements", "is", "reads", "writes")  # words that may follow the name in a sentence
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_recipe_keys_are_documented_as_they_are():
    assert key_reference().strip() in (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")


def commands():
    """`verb` or `verb subverb` -> the command."""
    found = {}
    for name, command in get_command(app).commands.items():
        children = getattr(command, "commands", None)
        found |= {f"{name} {k}": v for k, v in children.items()} if children else {name: command}
    return found


def test_every_command_and_option_written_down_exists():
    known = commands()
    for page in PAGES:
        for line in re.findall(r"thermofusion ([a-z]+[^`\n|]*)", page.read_text(encoding="utf-8")):
            words = line.split()
            if words[0] in PROSE:
                continue
            name = next((n for n in (" ".join(words[:2]), words[0]) if n in known), None)
            if name is None and words[0] == "recipe":
                continue
            assert name, f"{page.name}: thermofusion {line}"
            options = {o for p in known[name].params for o in getattr(p, "opts", [])}
            for option in re.findall(r"(?<!\S)--[a-z-]+", line):
                assert option in options | {"--help", "--version"}, f"{page.name}: thermofusion {line}"


def test_every_command_is_written_down():
    text = "\n".join(p.read_text(encoding="utf-8") for p in PAGES)
    missing = [name for name in commands() if f"thermofusion {name}" not in text]
    assert not missing


def test_keys_set_in_the_documentation_exist():
    for page in PAGES:
        for item in re.findall(r"--set ([a-z_]+\.[A-Za-z_0-9]+=[^\s`]+)", page.read_text(encoding="utf-8")):
            if item != "section.key=value":
                load_recipe({}, [item])
        text = re.sub(r"`[\w.]+\.json`", "", page.read_text(encoding="utf-8"))
        for section, key in re.findall(r"`([a-z]+)\.([a-z][A-Za-z_0-9]+)`", text):
            if section in Recipe.model_fields and section not in ("input", "output"):
                module = ROOT / "thermofusion" / f"{section}.py"
                if module.exists() and f"def {key}(" in module.read_text(encoding="utf-8"):
                    continue
                assert key in Recipe.model_fields[section].annotation.model_fields, f"{page.name}: {section}.{key}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_readmes_python_and_the_notebook_run(tmp_path, monkeypatch):
    """As it stands, on an excerpt of the demo under the name that it uses."""
    pytest.importorskip("pandas")
    import thermofusion as tf
    from thermofusion.scans.native.write import excerpt, write_scan

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    code = re.search(r"<!-- python -->\n```python\n(.*?)```", text, re.DOTALL).group(1)
    scan = tf.open_scan(data_dir() / "demo")
    write_scan(excerpt(scan, depth=slice(0, 12), color=slice(0, 4), thermal=slice(0, 4)), tmp_path / "my-scan")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    names = {p.name for p in (tmp_path / "result").iterdir()}
    assert {"mesh.ply", "mesh.glb", "result.json", "views", "skin.csv"} <= names

    # the notebook's cells, on the same excerpt; what they show was shown by the whole demo
    cells = json.loads((ROOT / "docs" / "example.ipynb").read_text(encoding="utf-8"))["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells if cell["cell_type"] == "code")
    room = {}
    for source in sources:
        exec(compile(source.replace('data_dir() / "demo"', '"my-scan"'), "example.ipynb", "exec"), room)
    assert len(room["measured"].differences) == 1
    assert room["picture"].size[0] > 500


def test_shipped_data_are_registered_with_their_hashes():
    registry = tomllib.loads((data_dir() / "registry.toml").read_text(encoding="utf-8"))
    listed = set()
    for entry in registry["file"]:
        assert entry["licence"]
        assert entry["source"]
        path = data_dir() / entry["path"]
        assert _sha256(path) == entry["sha256"], entry["path"]
        listed |= {path} if path.is_file() else {p for p in path.rglob("*") if p.is_file()}
    present = {p for p in data_dir().rglob("*") if p.is_file() and p.name != "registry.toml"}
    assert present == listed


def _sha256(path):
    """Of a file; of a folder: of the lines `sha256  path` of its files, sorted, as sha256sum prints them."""
    if path.is_file():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    names = sorted(p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file())
    lines = "".join(f"{hashlib.sha256((path / n).read_bytes()).hexdigest()}  {n}\n" for n in names)
    return hashlib.sha256(lines.encode()).hexdigest()
