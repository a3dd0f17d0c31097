"""The walls of the house: imports point one way, and commands import nothing heavy at the top."""

import ast
from pathlib import Path

import pytest

import rgbd_calib

ROOT = Path(rgbd_calib.__file__).parent
ORDER = ("errors", "geometry", "types", "io", "sensors", "synthetic", "stages", "report", "pipeline", "cli")
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


@pytest.mark.parametrize("path", [p for p in FILES if p.relative_to(ROOT).parts[0] == "stages"], ids=str)
def test_stages_do_not_import_each_other(path):
    own = path.relative_to(ROOT / "stages").with_suffix("").parts[0]
    for name in modules_imported(path):
        parts = name.split(".")
        if parts[:2] == ["rgbd_calib", "stages"] and len(parts) > 2:
            assert parts[2] == own, f"stage {own} must not import stage {parts[2]}"


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


def test_only_io_reads_and_writes_yaml_and_images():
    for path in FILES:
        own = path.relative_to(ROOT).parts[0]
        if own in ("geometry", "stages", "types.py"):
            text = path.read_text(encoding="utf-8")
            for word in ("imread", "imwrite", "open(", "print(", "yaml", "click"):
                assert f" {word}" not in text and f".{word}" not in text and f"({word}" not in text, f"{path}: {word}"


def test_choices_of_options_are_those_of_the_modules_that_do_the_work():
    """Commands repeat them, since importing them would slow --help down."""
    from rgbd_calib.cli import export, fuse
    from rgbd_calib.io import exports
    from rgbd_calib.report import splat

    assert fuse.VIEWS == splat.VIEWS
    assert tuple(exports.FORMATS) == export.FORMATS
