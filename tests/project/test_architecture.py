"""The walls of the house: imports point one way, and commands import nothing heavy at the top."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import rgbd_calib

ROOT = Path(rgbd_calib.__file__).parent
ORDER = (
    "errors",
    "geometry",
    "quality",
    "types",
    "patterns",
    "io",
    "sensors",
    "simulation",
    "views",
    "cameras",
    "capture",
    "rig",
    "trust",
    "report",
    "pipeline",
    "api",
    "cli",
)
FILES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT or path.stem in ORDER)
IDS = [str(path.relative_to(ROOT)) for path in FILES]


def modules_imported(path, everywhere=True):
    """Dotted names that a file imports; only those at its top level where not `everywhere`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = ast.walk(tree) if everywhere else tree.body
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; absolute ones can be read without counting dots"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def layer(name):
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "rgbd_calib" and parts[1] in ORDER else None


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_a_module_imports_only_from_earlier_packages(path):
    own = path.relative_to(ROOT).with_suffix("").parts[0]
    for name in modules_imported(path):
        seen = layer(name)
        if seen is not None:
            assert ORDER.index(seen) <= ORDER.index(own), f"{own} must not import {name}"


def test_an_import_that_is_turned_round_is_noticed(tmp_path):
    wrong = tmp_path / "camera.py"
    wrong.write_text("from rgbd_calib.rig.bundle import bundle\n")
    assert [name for name in modules_imported(wrong) if ORDER.index(layer(name)) > ORDER.index("geometry")]


@pytest.mark.parametrize("path", [p for p in FILES if p.relative_to(ROOT).parts[0] == "cli"], ids=str)
def test_commands_import_only_light_modules_at_the_top(path):
    allowed = ("click", "rgbd_calib.errors", "rgbd_calib.cli")
    third_party = ("numpy", "scipy", "cv2", "open3d", "yaml", "pydantic", "rich", "PIL", "plotly", "jinja2", "openni")
    for name in modules_imported(path, everywhere=False):
        root = name.split(".")[0]
        assert root not in third_party, f"{name} belongs into the command's body: --help must be quick"
        if root == "rgbd_calib" and name != "rgbd_calib":
            assert name.startswith(allowed), f"{name} belongs into the command's body: --help must be quick"


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_files_stay_short_enough_to_read(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


PURE = [
    p
    for p in FILES
    if p.relative_to(ROOT).with_suffix("").parts[0]
    in {"geometry", "quality", "types", "patterns", "views", "cameras", "rig", "trust"}
]


@pytest.mark.parametrize("path", PURE, ids=str)
def test_only_io_reads_and_writes(path):
    assert not {"yaml", "click"} & set(modules_imported(path))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", None) or getattr(node.func, "attr", None)
            assert name not in ("open", "print", "imread", "imwrite", "read_text", "write_text"), (
                f"{path}:{node.lineno}"
            )


def test_choices_of_options_are_those_of_the_modules_that_do_the_work():
    """Commands repeat them, since importing them would slow --help down."""
    from rgbd_calib.cli import export, fuse
    from rgbd_calib.io import exports
    from rgbd_calib.report import splat

    assert fuse.VIEWS == splat.VIEWS
    assert tuple(exports.FORMATS) == export.FORMATS


def test_no_public_class_name_stands_twice():
    """A name that two classes share says the subject of neither."""
    homes = defaultdict(list)
    for path in FILES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(str(path.relative_to(ROOT)))
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}
