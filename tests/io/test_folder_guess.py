"""What names of files and folders tell `init`: cameras, frames, kinds, times, and what they do not tell."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import folder_guess
from rgbd_calib.io import layout as layout_of_files
from rgbd_calib.io.frame_names import times_us
from rgbd_calib.io.layout import FilePatterns
from rgbd_calib.io.sniff import Sniffed

N = range(12)


def names(form: str, cameras, frames=N, **kinds: str) -> dict[str, str]:
    return {form.format(c=c, k=k, i=i): pixels for c in cameras for i in frames for k, pixels in kinds.items()}


LAYOUTS = {
    "flat and folders": (
        names("rgb_C{c}_{i:04d}.jpg", (1, 2), k="color") | names("C{c}/depth_{i:04d}.tiff", (1, 2), k="float"),
        ("rgb_{camera}_{frame}.jpg", "{camera}/depth_{frame}.tiff", None),
        ("C1", "C2"),
    ),
    "more cameras than frames": (
        names("{k}_C{c}_{i:04d}.png", range(8), range(5), rgb="color", depth="grey 16"),
        ("rgb_{camera}_{frame}.png", "depth_{camera}_{frame}.png", None),
        tuple(f"C{i}" for i in range(8)),
    ),
    "words for cameras": (
        names("{c}/{k}/{i}.png", ("left", "right"), rgb="color", depth="grey 16"),
        ("{camera}/rgb/{frame}.png", "{camera}/depth/{frame}.png", None),
        ("left", "right"),
    ),
    "kind first": (
        names("{k}/cam_{c}/{i}.png", ("left", "right"), rgb="color", depth="grey 16"),
        ("rgb/cam_{camera}/{frame}.png", "depth/cam_{camera}/{frame}.png", None),
        ("left", "right"),
    ),
    "a folder a frame": (
        names("frame_{i:04d}/cam{c}_{k}.png", (0, 1, 2), color="color", depth="grey 16"),
        ("frame_{frame}/{camera}_color.png", "frame_{frame}/{camera}_depth.png", None),
        ("cam0", "cam1", "cam2"),
    ),
    "camera twice": (
        names("C{c}/C{c}_{k}_{i:03d}.png", (1, 2), rgb="color", d="grey 16"),
        ("{camera}/{camera}_rgb_{frame}.png", "{camera}/{camera}_d_{frame}.png", None),
        ("C1", "C2"),
    ),
    "one camera, three kinds": (
        names("{i:04d}_{k}.png", (1,), color="color", depth="grey 16", ir="grey 16"),
        ("{frame}_color.png", "{frame}_depth.png", "{frame}_ir.png"),
        ("C1",),
    ),
    "two numbers, one of them of a frame": (
        names("rgb/{i:06d}-{i}00033.jpg", (1,), k="color") | names("depth/{i:06d}-{i}00777.png", (1,), k="grey 16"),
        ("rgb/{frame}-*.jpg", "depth/{frame}-*.png", None),
        ("C1",),
    ),
    "serial numbers": (
        names("{c}/{k}/{i:05d}.png", (840412060551, 840412060917), color="color", depth="grey 16"),
        ("{camera}/color/{frame}.png", "{camera}/depth/{frame}.png", None),
        ("840412060551", "840412060917"),
    ),
    "registered depth beside raw depth": (
        names("{k}/{i}.png", (1,), color="color", depth="grey 16", depth_aligned="grey 16", depth_vis="color"),
        ("color/{frame}.png", "depth_aligned/{frame}.png", None),
        ("C1",),
    ),
    "types that differ by camera": (
        {f"C{c}/color/{i:06d}.{s}": "color" for c, s in ((1, "png"), (2, "jpg")) for i in N},
        ("{camera}/color/{frame}.*", None, None),
        ("C1", "C2"),
    ),
    "depth of one camera of two": (
        names("rgb_{c}_{i}.png", ("left", "right"), k="color") | names("depth_left_{i}.png", (1,), k="grey 16"),
        ("rgb_{camera}_{frame}.png", "depth_{camera}_{frame}.png", None),
        ("left", "right"),
    ),
    "grey cameras": (
        names("cam{c}/img{i}.bmp", (1, 2, 3), k="grey 8"),
        ("{camera}/img{frame}.bmp", None, None),
        ("cam1", "cam2", "cam3"),
    ),
    "a grey camera beside a coloured one": (
        {
            f"C{c}/{k}/{i}.png": ("grey 8" if c == 1 else "color") if k == "color" else "grey 16"
            for c in (1, 2)
            for i in range(5)
            for k in ("color", "depth")
        },
        ("{camera}/color/{frame}.png", "{camera}/depth/{frame}.png", None),
        ("C1", "C2"),
    ),
    "suffixes of one format in several cases": (
        {
            f"C{c}/{k}/IMG_{i}{s}": p
            for c in (1, 2)
            for i, s in enumerate((".JPG", ".jpeg", ".Jpg", ".jpg"))
            for k, p in (("Color", "color"),)
        },
        ("{camera}/Color/IMG_{frame}.*", None, None),
        ("C1", "C2"),
    ),
    "no separators": (
        names("{k}C{c}_{i}.png", (1, 2), color="color", depth="grey 16"),
        ("colorC{camera}_{frame}.png", "depthC{camera}_{frame}.png", None),
        ("1", "2"),
    ),
    "no numbers": (
        {f"{k}/{i}.png": p for k, p in (("rgb", "color"), ("depth", "grey 16")) for i in ("near", "far", "left")},
        ("rgb/{frame}.png", "depth/{frame}.png", None),
        ("C1",),
    ),
}


@pytest.fixture
def pretend(monkeypatch):
    """A folder of files that exist by name and header only."""

    def set_files(files: dict[str, str]) -> Path:
        root = Path("/recording")
        monkeypatch.setattr(folder_guess, "walk", lambda folder: iter(sorted(files)))
        monkeypatch.setattr(
            folder_guess, "sniff", lambda path: Sniffed(files[path.relative_to(root).as_posix()], 64, 48)
        )
        return root

    return set_files


@pytest.mark.parametrize("layout", LAYOUTS)
def test_names_tell_cameras_frames_and_kinds(pretend, layout):
    files, patterns, cameras = LAYOUTS[layout]
    guess = folder_guess.guess_layout(pretend(files))
    assert guess.patterns == FilePatterns(*patterns) and guess.cameras == cameras
    # what the patterns take is what was guessed
    for kind, of_kind in guess.streams.items():
        for camera, stream in of_kind.items():
            pattern = guess.patterns.by_kind()[kind]
            takes = layout_of_files._compile(pattern, (camera,))
            named = [f for f in files if takes.fullmatch(f)]
            assert sorted(named) == sorted(stream.files.values())


@pytest.mark.parametrize(
    ("files", "needle"),
    [
        (names("cam{c}/{k}.png", (1, 2), rgb="color", depth="grey 16"), "no colour images found; seen: 2 files cam1"),
        (
            names("depth/{i}.png", (1,), k="grey 16"),
            r"no colour images found; seen: depth/\{frame\}.png \(12, 64x48 px",
        ),
        ({}, "no colour images found; seen: no images"),
        (
            names("rgb{c}_{i}.png", (1, 2), k="color") | names("depth{c}_{i}.png", (3, 4), k="grey 16"),
            r"depth images depth3_\{frame\}.png, .* the cameras are .*--depth PATTERN",
        ),
    ],
)
def test_names_that_do_not_tell_are_refused(pretend, files, needle):
    with pytest.raises(ConfigError, match=needle):
        folder_guess.guess_layout(pretend(files))


DAY = [f"20240501_12{30 + (50 + i) // 60:02d}{(50 + i) % 60:02d}_{(137 * i) % 1000:03d}" for i in N]
DECIMALS = [f"{1305031102.1 + i / 7.5:.6f}" for i in N]


@pytest.mark.parametrize(
    ("stems", "form"),
    [
        (DAY, "{c}/{k}_{t}.png"),
        (DECIMALS, "{c}/{k}/{t}.png"),
        ([f"{0.1234 + 0.5 * i:.4f}" for i in N], "{c}/{k}/{t}.png"),
        ([f"2024-05-01_12-{30 + i // 6}-{i % 6 * 10:02d}" for i in N], "{c}_{t}_{k}.png"),
        ([f"{1305031102 + i // 8}-{125_000_000 * (i % 8)}" for i in N if i % 8], "{k}/{c}/{t}.png"),
    ],
)
def test_a_time_in_a_name_is_one_number(pretend, stems, form):
    cameras = ("cam0", "cam1")
    kinds = {"rgb": "color", "depth": "grey 16"}
    files = {form.format(c=c, k=k, t=t): pixels for c in cameras for t in stems for k, pixels in kinds.items()}
    guess = folder_guess.guess_layout(pretend(files))
    assert guess.cameras == cameras
    assert guess.patterns.color == form.replace("{c}", "{camera}").replace("{t}", "{frame}").replace("{k}", "rgb")
    assert all(list(s.files) == sorted(stems) for of_kind in guess.streams.values() for s in of_kind.values())


@pytest.mark.parametrize(
    ("name", "time_us"),
    [
        ("1305031102.175304", 1_305_031_102_175_304),
        ("0.1234", 123_400),
        ("1697000000007", 1_697_000_000_007_000),
        ("1697000000007123", 1_697_000_000_007_123),
        ("1520530308199447626", 1_520_530_308_199_448),
        ("1305031102_000400000", 1_305_031_102_000_400),
        ("20240501_123000_107", 1_714_566_600_107_000),
        ("2024-05-01_12-30-00", 1_714_566_600_000_000),
        ("20249901_123000", None),
        ("000017", None),
        ("840412060551", None),
        ("near", None),
    ],
)
def test_times_that_names_say(name, time_us):
    assert times_us([name]) == (None if time_us is None else [time_us])
    assert times_us([]) is None


def test_colour_in_the_geometry_of_depth_is_colour(pretend):
    aligned = names("{c}/{k}/{i}.png", ("C1", "C2"), color_to_depth="color", depth="grey 16")
    guess = folder_guess.guess_layout(pretend(aligned))
    assert guess.patterns == FilePatterns("{camera}/color_to_depth/{frame}.png", "{camera}/depth/{frame}.png")
    both = aligned | names("{c}/{k}/{i}.jpg", ("C1", "C2"), color="color")
    guess = folder_guess.guess_layout(pretend(both))
    assert guess.patterns.color == "{camera}/color/{frame}.jpg"
    assert "12 files C1/color_to_depth/{frame}.png are not used (64x48 px, color)" in guess.remarks


def test_names_of_cameras_in_any_script(pretend):
    guess = folder_guess.guess_layout(pretend(names("相机{c}/{k}/{i}.png", (1, 2), color="color", depth="grey 16")))
    assert guess.cameras == ("相机1", "相机2")


@pytest.mark.parametrize(
    ("files", "needle"),
    [
        (
            names("{c}/{k}/{i}.png", ("C1", "C2"), color="color", depth="grey 8"),
            "depth of 16 bits or floating point expected",
        ),
        (
            names("take{c}/cam1/{i}.png", (1, 2), k="color") | names("take{c}/cam2/{i}.png", (1, 2), k="color"),
            "several recordings",
        ),
        ({"session.zip": "color"}, "seen: 1 .zip in .*Unpack session.zip"),
        ({"cam1.mp4": "color"}, r"rgbd-calib import /recording -o RECORDING"),
    ],
)
def test_what_is_refused_says_what_to_do(pretend, files, needle):
    with pytest.raises(ConfigError, match=needle):
        folder_guess.guess_layout(pretend(files))
