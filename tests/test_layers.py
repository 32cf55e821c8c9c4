"""The house: who may import whom, and how large a room may grow. Read from the source, nothing is run."""

from __future__ import annotations

import ast
import resource
import subprocess
import sys
from functools import cache

import pytest
from conftest import ROOT

PACKAGE = ROOT / "thermofusion"
NOUNS = ("types", "errors", "version", "progress")
BASE = (*NOUNS, "compiled", "robust", "recipe", "files", "geometry")
STEPS = ("tracking", "surface", "rig", "mapping", "temperature")
ALL = (
    *BASE,
    "physics",
    "scans",
    "depth",
    "motion",
    *STEPS,
    "diagnosis",
    "export",
    "regions",
    "report",
    "results",
    "pipeline",
)

# Room -> rooms that it may import, late and typing imports included. What is not named is forbidden.
MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "version": (),
    "errors": (),
    "types": (),
    "progress": (),
    "compiled": (),
    "robust": ("types", "errors"),
    "files": ("types", "errors", "version"),
    "recipe": ("errors", "files"),
    "geometry": ("types", "errors", "compiled", "robust"),
    "physics": ("types", "errors", "compiled", "recipe"),
    "scans": (*BASE, "physics"),
    "depth": BASE,
    "tracking": (*BASE, "depth", "scans"),
    "motion": BASE,
    "surface": (*BASE, "depth", "motion"),
    "rig": (*BASE, "physics", "motion"),
    "mapping": (*BASE, "physics", "motion", "rig", "scans"),
    "temperature": (*BASE, "physics", "mapping"),
    "diagnosis": (*BASE, "tracking", "rig", "mapping", "temperature"),
    "export": BASE,
    "regions": (*BASE, "export"),
    "report": (*BASE, "physics", "motion", "diagnosis", "export", "regions", *STEPS),
    "results": (*BASE, "motion", "export", "regions", "report", *STEPS),
    "pipeline": (*BASE, "scans", "depth", *STEPS, "export", "report", "results"),
    "handover": (*BASE, "export", "regions", "report"),
    "judge": ALL,
    "calibration": (*BASE, "physics", "scans", "report"),
    "recording": (*BASE, "physics", "scans"),
    "live": (*BASE, "physics", "depth", "scans", "tracking"),
    "phantom": (*NOUNS, "files", "geometry"),
    "batch": ALL,
    "paper": (*ALL, "judge", "phantom"),
    "cli": (*ALL, "batch", "judge", "calibration", "recording", "live", "phantom", "paper", "handover"),
    "__init__": ALL,
    "__main__": ("cli", "errors"),
}
# Sub-rooms of calibration: a board is printed, detected, fitted.
CALIBRATION = {"board": (), "detect": ("board",), "fit": ("board", "detect"), "thermal": ()}
# A module of one room that another may use, although the room itself is closed to it.
PHANTOM_GEOMETRY = {"geometry.rigid", "geometry._open3d"}
ONE_PLACE = {
    "usb": {"recording"},
    "numba": {"compiled"},
    "distributed": {"batch"},
    "fsspec": {"batch"},
    "typer": {"cli"},
    "rich": {"cli"},
}
PRINTS_OR_EXITS = ("print", "sys.exit", "exit", "quit")
MOST_FILES, MOST_ON_TOP, MOST_LINES, MOST_ARGUMENTS, MANY_ARGUMENTS, WITH_MANY = 16, 10, 60, 9, 7, 4


@cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def sources():
    return tuple(sorted(PACKAGE.rglob("*.py")))


def module_of(path):
    """`thermofusion/rig/align.py` -> ("rig", "align"); a room's `__init__` -> ("rig",)."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts


MODULES = {".".join(module_of(p)) for p in sources()}


def imports(path):
    """(line, module of ours as a dotted name, or top-level name of another) for every import, anywhere in a file."""
    here = list(module_of(path))
    package = here if path.name == "__init__.py" and here != ["__init__"] else here[:-1]
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, None, a.name.split(".")[0]) for a in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.lineno, None, (node.module or "").split(".")[0]
        elif isinstance(node, ast.ImportFrom):
            stem = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
            for alias in node.names:
                full = ".".join([*stem, alias.name])
                yield node.lineno, full if full in MODULES else ".".join(stem) or "__init__", None


def test_every_arrow_is_in_the_table():
    wrong = []
    for path in sources():
        room = module_of(path)[0]
        assert room in MAY_IMPORT, f"{path}: a room that the table does not know"
        for line, ours, _ in imports(path):
            if ours is None or ours.split(".")[0] == room:
                continue
            allowed = ours.split(".")[0] in MAY_IMPORT[room]
            if room == "phantom" and ours.startswith("geometry"):
                allowed = ours in PHANTOM_GEOMETRY
            if not allowed:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {ours}")
    assert not wrong, wrong


def test_rooms_of_calibration_build_on_each_other():
    for path in sources():
        here = module_of(path)
        if here[0] != "calibration" or len(here) < 3:
            continue
        for line, ours, _ in imports(path):
            there = (ours or "").split(".")
            if there[0] == "calibration" and len(there) > 2 and there[1] != here[1]:
                assert there[1] in CALIBRATION[here[1]], f"{path}:{line} imports {ours}"


def test_no_circle():
    arrows = {m: set() for m in MODULES}
    for path in sources():
        arrows[".".join(module_of(path))] |= {ours for _, ours, _ in imports(path) if ours in MODULES}
    done, way = set(), []

    def visit(module):
        if module in way:
            pytest.fail(f"a circle: {' -> '.join([*way[way.index(module) :], module])}")
        if module not in done:
            way.append(module)
            for following in sorted(arrows[module] - {module}):
                visit(following)
            way.pop()
            done.add(module)

    for module in sorted(arrows):
        visit(module)


def test_some_libraries_enter_at_one_place():
    for path in sources():
        name = path.relative_to(PACKAGE).as_posix()
        for line, _, library in imports(path):
            if library == "open3d":
                assert name == "geometry/_open3d.py", f"{name}:{line}"
            if library in ONE_PLACE:
                assert {name, name.split("/")[0]} & ONE_PLACE[library], f"{name}:{line} {library}"


def test_pure_rooms_know_neither_open3d_nor_files():
    for path in sources():
        room = module_of(path)[0]
        found = {ours or library for _, ours, library in imports(path)}
        if room in ("physics", "temperature", "robust"):
            assert not found & {"open3d", "os", "io", "json", "csv", "pathlib", "geometry._open3d"}, path
            assert not any(str(f).startswith(("files", "scans")) for f in found), path


def test_only_the_command_line_prints_or_exits():
    for path in sources():
        if module_of(path)[0] in ("cli", "__main__"):
            continue
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in PRINTS_OR_EXITS, f"{path}:{node.lineno}"


def test_only_the_pipeline_and_what_stands_on_it_take_the_whole_recipe():
    above = ("recipe", "pipeline", "batch", "cli", "judge", "results", "report", "paper")
    for path in sources():
        if module_of(path)[0] in above:
            continue
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef):
                for a in (*node.args.args, *node.args.kwonlyargs):
                    assert a.annotation is None or ast.unparse(a.annotation) != "Recipe", f"{path}:{node.lineno}"


def test_rooms_and_functions_stay_small():
    folders: dict = {}
    for path in sources():
        folders.setdefault(path.parent, []).append(path)
    assert max(map(len, folders.values())) <= MOST_FILES
    assert len([p for p in PACKAGE.iterdir() if p.is_file()]) <= MOST_ON_TOP
    many = []
    for path in sources():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno + 1 <= MOST_LINES, f"{path}:{node.lineno} {node.name}"
                names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                count = len(names) - (names[:1] in (["self"], ["cls"]))
                many += [(count, f"{path}:{node.lineno} {node.name}")] if count > MANY_ARGUMENTS else []
    assert len(many) <= WITH_MANY, many
    assert not [m for m in many if m[0] > MOST_ARGUMENTS]


def test_public_functions_say_what_they_do():
    for path in sources():
        assert ast.get_docstring(tree(path)) or not tree(path).body, path
        for node in tree(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{path}:{node.lineno} {node.name}"


def as_table():
    """The arrows for docs/architecture.md."""
    named = {"base": BASE, "the steps": STEPS, "nouns": NOUNS}

    def words(rooms):
        left, out = set(rooms), []
        if set(ALL) <= left:
            out, left = ["`pipeline` and all above it"], left - set(ALL)
        for name, group in named.items():
            if set(group) <= left:
                out.append(f"*{name}*")
                left -= set(group)
        return ", ".join([*out, *(f"`{r}`" for r in rooms if r in left)]) or "nothing"

    rows = [f"| `{room}` | {words(rooms)} |" for room, rooms in MAY_IMPORT.items() if not room.startswith("__")]
    return "\n".join(["| room | may import |", "|---|---|", *rows])


def test_the_architecture_page_shows_the_table():
    assert as_table() in (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), as_table()


def test_help_answers_at_once_without_loading_open3d():
    code = "import sys; import thermofusion.cli; assert not {'open3d', 'scipy', 'cv2'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "thermofusion", "--help"], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # CPU time, which a busy machine does not stretch as it does the clock; 0.35 s on an idle one
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.8
