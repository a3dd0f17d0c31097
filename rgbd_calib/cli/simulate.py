"""`rgbd-calib simulate`: recordings with ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli import options
from rgbd_calib.cli.scene_change import scene_change_options

if TYPE_CHECKING:
    from collections.abc import Callable

    from rgbd_calib.simulation.changes import SceneChange
    from rgbd_calib.simulation.params import SimulationParams
    from rgbd_calib.types import BoardType


@click.command("simulate")
@click.argument("out", type=options.OUTPUT)
@click.option("--cameras", type=click.IntRange(2, 99), default=4, show_default=True, help="How many cameras.")
@click.option(
    "--layout",
    type=click.Choice(["arc", "ring"]),
    default="arc",
    show_default=True,
    help="Cameras side by side on an arc, or in a ring all round.",
)
@click.option(
    "--frames",
    type=click.IntRange(1, 1000),
    default=None,
    help="Board poses shared by the cameras.  [default: 30, or 8 per camera if that is more]",
)
@click.option(
    "--intrinsic-views",
    type=click.IntRange(0, 1000),
    default=20,
    show_default=True,
    help="Close views of the board per camera.",
)
@click.option(
    "--distances",
    default="0.6,0.9,1.2,1.5,1.8,2.2,2.6,3.0,3.5,4.0",
    show_default=True,
    metavar="METRES,...",
    help="Wall distances in depth_bias/; each is moved by up to 3 cm, as by hand.",
)
@click.option("--width", type=click.IntRange(160, 4096), default=640, show_default=True, help="Image width, px.")
@click.option("--height", type=click.IntRange(120, 4096), default=480, show_default=True, help="Image height, px.")
@click.option("--board", default="9x6", show_default=True, metavar="COLSxROWS", help="Inner corners of the board.")
@options.pattern_options(
    "--board-type", "Pattern. Boards with markers are also shown cut by the borders of the images."
)
@click.option("--square", type=options.Number(0.005, 0.5), default=0.060, show_default=True, help="Square, metres.")
@click.option(
    "--two-sided/--one-sided", default=True, show_default=True, help="The pattern on both faces, or on the front only."
)
@click.option(
    "--thickness",
    type=options.Number(0.0, 0.05),
    default=0.006,
    show_default=True,
    help="Thickness of the board, metres.",
)
@click.option(
    "--sigma-grey",
    type=options.Number(0.0, 50.0),
    default=1.5,
    show_default=True,
    help="Noise of the colour images at middle grey, steps of 255.",
)
@click.option(
    "--blur",
    type=options.Number(0.0, 5.0),
    default=0.6,
    show_default=True,
    help="Blur of the lenses, px (one sigma).",
)
@click.option(
    "--fringe",
    type=options.Number(-5.0, 5.0),
    default=0.0,
    show_default=True,
    help="Lateral chromatic aberration: shift of red outwards and of blue inwards in the image corners, px.",
)
@click.option(
    "--jpeg",
    type=click.IntRange(1, 100),
    default=None,
    help="Save colour images as JPEG of this quality.  [default: PNG]",
)
@click.option(
    "--depth-k",
    type=options.Number(0.0, 0.05),
    default=None,
    help="Depth noise: one sigma is k z^2, z in metres; at least the quantisation of disparity, 0.00084 for structured light. "
    "For tof: one sigma on white paper at 1 m, metres.  [default: 0.0016; tof 0.0007; stereo 0.004]",
)
@click.option(
    "--sensor",
    type=click.Choice(["structured-light", "tof", "stereo"]),
    default="structured-light",
    show_default=True,
    help="Depth sensor; tof is time of flight.",
)
@click.option(
    "--unregistered",
    is_flag=True,
    help="Depth is not registered to colour: a depth camera 52 mm beside the colour camera.",
)
@click.option(
    "--depth-size",
    type=click.Choice(["512x424", "640x576", "640x480"]),
    default=None,
    help="With --unregistered: size of the depth images, px.  [default: 512x424 for tof, else 640x480]",
)
@click.option("--infrared", is_flag=True, help="With --unregistered: also save infrared images.")
@click.option(
    "--lens",
    default="brown",
    show_default=True,
    metavar="KIND,...",
    help="Lens models of the colour cameras, in turn: brown (5 coefficients), rational (8), fisheye (Kannala-Brandt).",
)
@click.option(
    "--wave",
    type=options.Number(1.0, 600.0),
    default=None,
    metavar="SECONDS",
    help="Carry the board for so long before free-running cameras, in place of the shared frames: OUT/wave.",
)
@click.option(
    "--rate", type=options.Number(1.0, 120.0), default=30.0, show_default=True, help="With --wave: frames per second."
)
@click.option(
    "--clock-offset",
    type=options.Number(0.0, 3600.0),
    default=5.0,
    show_default=True,
    help="With --wave: offsets of the clocks are drawn from +- this, seconds.",
)
@click.option(
    "--jitter",
    type=options.Number(0.0, 0.05),
    default=0.0,
    show_default=True,
    help="With --wave: noise of the time stamps, seconds (one sigma).",
)
@click.option(
    "--readout",
    type=options.Number(0.0, 0.05),
    default=0.0,
    show_default=True,
    help="With --wave: readout time of a rolling shutter, seconds.",
)
@click.option(
    "--lost",
    type=options.Number(0.0, 0.5),
    default=0.02,
    show_default=True,
    help="With --wave: share of dropped frames.",
)
@click.option("--ideal", is_flag=True, help="No print, depth field, registration, wall or image errors.")
@click.option(
    "--print-scale",
    type=options.Number(0.0, 0.05),
    default=0.0,
    show_default=True,
    help="Error of the stated square size, relative (one sigma).",
)
@click.option("--no-print-errors", is_flag=True, help="Exact prints on a flat board.")
@click.option("--no-depth-field", is_flag=True, help="No depth error over the image.")
@click.option(
    "--no-registration-error", is_flag=True, help="Exact registration; with --unregistered, exact factory calibration."
)
@click.option("--no-wall-errors", is_flag=True, help="Walls square to the camera, exact distances.")
@click.option("--no-multipath", is_flag=True, help="tof: no multipath and stray light.")
@click.option("--no-drift", is_flag=True, help="tof: no temperature drift.")
@click.option("--no-image-errors", is_flag=True, help="Constant light and exposure, no defocus.")
@click.option("--no-bias", is_flag=True, help="No depth bias.")
@click.option(
    "--no-noise", is_flag=True, help="Like --ideal, and no noise, blur or bias; depth is exact to the millimetre."
)
@scene_change_options
@options.seed_option
@options.overwrite_option
@options.jobs_option
def command(
    out: Path,
    cameras: int,
    layout: str,
    frames: int | None,
    intrinsic_views: int,
    distances: str,
    width: int,
    height: int,
    board: str,
    kind: BoardType,
    marker_m: float | None,
    dictionary: str | None,
    square: float,
    two_sided: bool,
    thickness: float,
    sigma_grey: float,
    blur: float,
    fringe: float,
    jpeg: int | None,
    depth_k: float | None,
    sensor: str,
    unregistered: bool,
    depth_size: str | None,
    infrared: bool,
    lens: str,
    wave: float | None,
    rate: float,
    clock_offset: float,
    jitter: float,
    readout: float,
    lost: float,
    ideal: bool,
    print_scale: float,
    no_print_errors: bool,
    no_depth_field: bool,
    no_registration_error: bool,
    no_wall_errors: bool,
    no_multipath: bool,
    no_drift: bool,
    no_image_errors: bool,
    no_bias: bool,
    no_noise: bool,
    scene_change: Callable[[], tuple[SceneChange, int] | None],
    depth_readings: int,
    seed: int,
    overwrite: bool,
    jobs: int | None,
) -> None:
    """Render simulated recordings with ground truth into the folder OUT.

    A furnished room, cameras on an arc or in a ring, a board on a stand. By default the recordings have the errors of
    real ones: a print that is not square, on a bent plate, with a misaligned sheet on its back; a depth bias, a depth error
    over the image and a misregistration for each camera; walls that are not square to the camera, at distances measured by
    tape; auto exposure, defocus and changing light. --ideal leaves only lens distortion, depth bias and noise. The same
    options and seed give the same bytes.

    \b
    OUT/extrinsic         the board, seen by several cameras
    OUT/wave              with --wave, in place of extrinsic: a carried board, each camera with its own frames and clock
    OUT/intrinsic         close views of the board, one camera at a time
    OUT/depth_bias        a wall at known distances
    OUT/truth.yaml        true rig, board shape, walls, and board pose of each frame
    OUT/true_corners.csv  true corner positions in each image, and their visibility

    With --snapshot, the empty room instead, before and after a change, as `verify --snapshot` compares them. The same
    options and seed give the same rig with and without --snapshot.

    \b
    OUT/old, OUT/new      one colour image and some depth images of each camera
    OUT/truth.yaml        true rig, and in quality.snapshot the motion of each camera

    \b
    Examples:
      rgbd-calib simulate demo
      rgbd-calib simulate ring8 --cameras 8 --layout ring --seed 3
      rgbd-calib simulate perfect --ideal
      rgbd-calib simulate tags --board-type aprilgrid --board 12x8 --square 0.04
      rgbd-calib simulate kinects --sensor tof --unregistered --infrared --lens rational
      rgbd-calib simulate clean --no-noise --frames 12
      rgbd-calib simulate bumped --snapshot --move C2:8,0,0,0,0.4,0 --people 2 --light 0.5
      rgbd-calib simulate carried --wave 30 --intrinsic-views 0 --distances ""
    """
    options.refuse_existing(out, overwrite, folder=True)
    cols, rows = _board_size(board)
    wall_m = _distances(distances)
    lenses = _lenses(lens)
    if not unregistered and (infrared or depth_size):
        raise click.UsageError("--infrared and --depth-size apply to unregistered depth. Add --unregistered")

    import os
    import time

    from rgbd_calib.io.files import whole_folder
    from rgbd_calib.patterns import of_type
    from rgbd_calib.simulation.clocks import WaveParams
    from rgbd_calib.simulation.color_sensor import ColorNoise
    from rgbd_calib.simulation.realism import IDEAL, Part, Realism
    from rgbd_calib.simulation.recording import SimulationParams, simulate
    from rgbd_calib.types import Board

    switches: dict[Part, bool] = {
        "print": no_print_errors,
        "depth_field": no_depth_field,
        "registration": no_registration_error,
        "walls": no_wall_errors,
        "multipath": no_multipath,
        "drift": no_drift,
        "images": no_image_errors,
    }
    plain = Board(cols, rows, square, two_sided, thickness if two_sided else 0.0)
    off = [part for part, exact in switches.items() if exact]
    path = None if wave is None else WaveParams(wave, rate, clock_offset, jitter_s=jitter, readout_s=readout, lost=lost)
    params = SimulationParams(
        cameras=cameras,
        layout=layout,  # type: ignore[arg-type]
        frames=frames,
        intrinsic_views=intrinsic_views,
        distances_m=wall_m,
        width=width,
        height=height,
        seed=seed,
        board=of_type(plain, kind, marker_m, dictionary),
        color_noise=ColorNoise(0.0, 0.0, fringe_px=fringe)
        if no_noise
        else ColorNoise(blur, sigma_grey, fringe_px=fringe),
        sensor=sensor,  # type: ignore[arg-type]
        depth_noise=_depth_noise(sensor, depth_k, no_noise, ideal),
        lenses=lenses,  # type: ignore[arg-type]
        depth_size=_size(depth_size or _OWN_SIZES.get(sensor, "640x480")) if unregistered else None,
        infrared=infrared,
        depth_readings=depth_readings,
        bias=not (no_bias or no_noise),
        jpeg_quality=jpeg,
        wave=path,
        realism=IDEAL if ideal or no_noise else Realism(print_scale=print_scale).without(*off),
    )
    begin = time.monotonic()
    change = scene_change()
    if change is not None:
        _snapshots(out, params, *change, overwrite, jobs or os.cpu_count() or 1)
        return
    with whole_folder(out, overwrite) as folder:
        counts = simulate(folder, params, jobs or os.cpu_count() or 1, options.progress)
    options.say(
        f"{out}: {cameras} cameras in {'a ring' if layout == 'ring' else 'an arc'}; "
        + ", ".join(f"{name} {n} frames" for name, n in counts.items())
        + f"; {time.monotonic() - begin:.0f} s"
    )


def _snapshots(
    out: Path, params: SimulationParams, change: SceneChange, frames: int, overwrite: bool, jobs: int
) -> None:
    from rgbd_calib.io.files import whole_folder
    from rgbd_calib.simulation.snapshot import simulate_snapshots

    with whole_folder(out, overwrite) as folder:
        changed = simulate_snapshots(folder, params, change, frames, jobs, options.progress)
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in changed.items())
    options.say(f"{out}: old and new snapshots of {params.cameras} cameras; changed: {shares}")


_OWN_SIZES = {"tof": "512x424"}


_OBLIQUE_M = 1e-4
"""Nguyen, Izadi, Lovell 2012."""


def _depth_noise(sensor: str, k: float | None, exact: bool, ideal: bool) -> Any:
    from rgbd_calib.simulation.depth_sensor import STEREO, DepthNoise
    from rgbd_calib.simulation.time_of_flight import TimeOfFlight

    if sensor == "tof":
        return TimeOfFlight(ideal=exact) if k is None else TimeOfFlight(k_m=k, ideal=exact)
    own = STEREO if sensor == "stereo" else DepthNoise()
    own = replace(own, ideal=exact, oblique_m=0.0 if ideal or exact else _OBLIQUE_M)
    return own if k is None else replace(own, k_per_m=k)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


def _lenses(text: str) -> tuple[str, ...]:
    kinds = tuple(part.strip() for part in text.split(","))
    if not set(kinds) <= {"brown", "rational", "fisheye"}:
        raise click.UsageError(f"--lens: brown, rational or fisheye expected, separated by commas, {text!r} found")
    return kinds


def _board_size(text: str) -> tuple[int, int]:
    cols, _, rows = text.lower().partition("x")
    if not (cols.isdigit() and rows.isdigit() and 3 <= int(cols) <= 40 and 3 <= int(rows) <= 40):
        raise click.UsageError(f"--board: {text!r} seen; inner corners as COLSxROWS, 3 to 40 each, needed, such as 9x6")
    return int(cols), int(rows)


def _distances(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        values = (-1.0,)
    if any(not 0.3 <= v <= 10 for v in values):
        raise click.UsageError(f"--distances: {text!r} seen; metres from 0.3 to 10 needed, such as 0.6,1.2,2.4")
    return values
