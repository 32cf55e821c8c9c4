"""The house: who may import whom. Read from the source, nothing is run."""

from __future__ import annotations

import ast
import resource
import subprocess
import sys

from conftest import ROOT

PACKAGE = ROOT / "thermofusion"
PURE = ("geometry", "radiometry", "emissivity", "crosscal", "blending")  # neither Open3D nor files


def imports(path):
    """Top-level modules a file imports anywhere: `thermofusion.x` as `.x`."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")[0]
            if node.level:
                found |= {f".{module}"} if module else {f".{a.name}" for a in node.names}
            else:
                found.add(module)
    return found


def sources():
    return sorted(PACKAGE.rglob("*.py"))


def test_the_core_knows_neither_open3d_nor_files():
    for name in PURE:
        found = imports(PACKAGE / f"{name}.py")
        assert not found & {"open3d", "._open3d", "pathlib", "os", "io", "json", "csv", ".rundir", ".scans"}, name


def test_open3d_and_usb_enter_at_one_place():
    for path in sources():
        if path.name not in ("_open3d.py",):
            assert "open3d" not in imports(path), path
        if path.parent.name != "devices" and path.name != "doctor.py":
            assert "usb" not in imports(path), path


def test_only_the_command_line_prints_or_exits():
    for path in sources():
        if path.parent.name == "cli" or path.name == "__main__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                assert name not in ("print", "sys.exit", "exit", "quit"), f"{path}:{node.lineno}"


def test_library_does_not_import_the_command_line():
    for path in sources():
        if path.parent.name != "cli" and path.name != "__main__.py":
            assert not imports(path) & {".cli", "typer", "rich"}, path


def test_public_functions_say_what_they_do():
    for path in sources():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert ast.get_docstring(tree) or not tree.body, path
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{path}:{node.lineno} {node.name}"


def test_help_answers_at_once_without_loading_open3d():
    code = "import sys; import thermofusion.cli; assert not {'open3d', 'scipy', 'cv2'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "thermofusion", "--help"], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # CPU time, which a busy machine does not stretch as it does the clock; 0.35 s on an idle one
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.8
