"""The same recording, settings and seed give the same bytes, wherever the boards were found and whatever was known."""

from __future__ import annotations

import re

import pytest
from small_recording import draw_recording
from threadpoolctl import threadpool_info, threadpool_limits

from rgbd_calib.geometry.blas import one_blas_thread
from rgbd_calib.pipeline.workers import one_thread


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Twenty-four images: more than are looked at without further processes."""
    return draw_recording(tmp_path_factory.mktemp("same") / "recording", 3, 8)


@pytest.fixture(scope="module")
def first(drawn):
    """What one process writes that knows nothing, by method."""
    return {}


def written(run, recording, folder, method, *options):
    """All that `calibrate` writes; the command line, which stands in the rig file, without its options."""
    files = [folder / name for name in ("rig.yaml", "rig.residuals.csv", "features.csv")]
    told = run(
        "calibrate",
        recording,
        "-o",
        files[0],
        "--correspondences",
        files[2],
        "--method",
        method,
        "--overwrite",
        *options,
    )
    assert told.status == 0, told.stderr
    text = files[0].read_text()
    command = re.compile(r"^  command: .*(\n    .*)*\n", re.MULTILINE)  # a long one is folded
    assert len(command.findall(text)) == 1
    return [command.sub("", text).encode(), *(path.read_bytes() for path in files[1:])], told


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("bundle", ("--jobs", 2)),
        ("bundle", ("--jobs", 4)),
        ("bundle", ("--dask",)),
        ("biobjective", ("--jobs", 4)),
    ],
)
def test_the_same_bytes_wherever_boards_are_found(drawn, first, run, tmp_path, monkeypatch, request, method, options):
    if method not in first:
        first[method], _ = written(run, drawn, tmp_path, method, "--jobs", 1, "--no-cache")
    if options == ("--dask",):
        options = ("--dask", request.getfixturevalue("cluster").address)
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    cold, told = written(run, drawn, tmp_path, method, *options)
    assert cold == first[method] and "from the cache" not in told.stderr
    warm, told = written(run, drawn, tmp_path, method, *options)
    assert warm == first[method] and "24 of 24 images from the cache" in told.stderr


def test_the_same_bytes_where_a_part_is_known(drawn, first, run, tmp_path, monkeypatch):
    """As after a kill: every other view is missing. The files' hashes, which are JSON, stay."""
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    cold, _ = written(run, drawn, tmp_path, "bundle", "--jobs", 2)
    kept = sorted((tmp_path / "cache").rglob("?" * 64))
    for entry in [path for path in kept if b'": [[' not in path.read_bytes()][::2]:
        entry.unlink()
    again, told = written(run, drawn, tmp_path, "bundle", "--jobs", 2)
    assert again == cold and "12 of 24 images from the cache" in told.stderr


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_linear_algebra_in_one_thread():
    with threadpool_limits(2, user_api="blas"):
        assert one_blas_thread(blas_threads)() == {1} and blas_threads() == {2}
        with one_thread():
            assert blas_threads() == {1}


@pytest.mark.parametrize("method", ["bundle", "biobjective"])
def test_the_same_bytes_for_any_number_of_blas_threads(drawn, run, tmp_path, monkeypatch, method):
    monkeypatch.setenv("RGBD_CALIB_CACHE", str(tmp_path / "cache"))
    made = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            made.append(written(run, drawn, tmp_path, method)[0])
    assert made[0] == made[1]
