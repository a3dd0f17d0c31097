"""`rgbd-calib capture`: record a rig."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rgbd_calib.cli.options import OUTPUT, Number, board_options, driver_option, redist_option, say
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.capture.session import CaptureResult

SNAPSHOT_FRAMES = 30
STILL_FRAMES = 10
"""A third of a second; what is left of the depth noise is less than what else depth errs by."""


@click.command()
@click.argument("out", type=OUTPUT)
@board_options
@click.option("--intrinsic", is_flag=True, help="One camera after the other, the board close in front of it.")
@click.option("--depth-bias", is_flag=True, help="One camera after the other, a wall at known distances.")
@click.option(
    "--snapshot",
    is_flag=True,
    help="One shot of the empty scene, depth the mean of 30 frames, for `verify --snapshot`: no board.",
)
@click.option(
    "--wave",
    type=Number(1.0, 3600.0),
    metavar="SECONDS",
    help="Record every frame of every camera for so long, while the board is carried; `calibrate` estimates the clocks.",
)
@click.option("--distances", metavar="M,M,...", help="With --depth-bias: the distances to go through, metres.")
@click.option("--on-still", is_flag=True, help="Take a shot whenever the board is held still in a new pose.")
@click.option("--interval", type=Number(0), help="Seconds between shots.  [default: 0.5]")
@click.option("--count", type=click.IntRange(1), help="Shots to take (of each camera, at each distance).")
@click.option("--until-enough", is_flag=True, help="End when nothing is missing any more.")
@click.option(
    "--until-mm",
    type=Number(0, min_open=True),
    metavar="MM",
    help="End when the expected error is at most so large; it is estimated while you film. Implies --on-still, unless --interval "
    "is given.",
)
@click.option(
    "--pairs-only", is_flag=True, help="Ask for common views of cameras only, not for coverage of each image."
)
@click.option(
    "--depth-frames",
    type=click.IntRange(1, 100),
    default=None,
    help="Depth is the mean of so many.  [default: 10 where the board is held still or a wall is filmed, 30 with "
    "--snapshot, else 1]",
)
@click.option("--alternate-emitters", is_flag=True, help="One infrared projector at a time, against interference.")
@click.option("--auto-exposure", is_flag=True, help="Leave exposure and white balance automatic.")
@click.option(
    "--device",
    "devices",
    multiple=True,
    metavar="ID=SERIAL",
    help="Record this camera (repeat); serial, USB path or uri.  [default: all]",
)
@click.option(
    "--sync", metavar="ID", help="A synchronisation cable joins the cameras: this one gives the pulse (not OpenNI2)."
)
@driver_option
@redist_option
@click.option("--append", is_flag=True, help="Resume a recording.")
@click.option(
    "--preview",
    is_flag=False,
    flag_value="8765",
    metavar="[HOST:]PORT",
    help="Show live pictures and coverage on a web page; on this computer only unless HOST says otherwise (0.0.0.0).",
)
@click.option("--settle", type=Number(0), default=2.0, show_default=True, help="Seconds for exposure to settle.")
@click.option(
    "--give-up",
    type=Number(1),
    default=15.0,
    show_default=True,
    help="End after so many seconds without any frame.",
)
@click.option("--color-only", is_flag=True, help="Leave depth out. Cameras without a depth sensor need no option.")
@click.option("--allow-unregistered", is_flag=True, help="Take cameras whose depth is not registered to colour.")
def command(
    out: Path,
    board: Callable[[], object],
    intrinsic: bool,
    depth_bias: bool,
    snapshot: bool,
    wave: float | None,
    distances: str | None,
    on_still: bool,
    interval: float | None,
    count: int | None,
    until_enough: bool,
    until_mm: float | None,
    pairs_only: bool,
    depth_frames: int | None,
    alternate_emitters: bool,
    auto_exposure: bool,
    devices: tuple[str, ...],
    sync: str | None,
    drivers: tuple[str, ...],
    redist: Path | None,
    append: bool,
    preview: str | None,
    settle: float,
    give_up: float,
    color_only: bool,
    allow_unregistered: bool,
) -> None:
    """Record a rig of OpenNI2 (Xtion, Kinect), RealSense, Azure Kinect and Orbbec cameras into the folder OUT.

    One recording is enough: with --until-mm, shared views are asked for first (near, far, tilted), then the board close to each
    camera, and the expected error is shown as it falls.

    \b
      rgbd-calib capture rig1 --board 9x6 --square 0.06 --until-mm 1.5 --preview
      rgbd-calib capture rig1/extrinsic --board 9x6 --square 0.06 --on-still --until-enough --preview
      rgbd-calib capture rig1/intrinsic --board 9x6 --square 0.06 --intrinsic
      rgbd-calib capture rig1/empty --snapshot
      rgbd-calib capture rig1/depth_bias --depth-bias --distances 0.8,1.2,1.6,2.0,2.5,3.0
      rgbd-calib capture rig1/wave --board 9x6 --square 0.06 --wave 30 --preview

    Ctrl-C stops cleanly, with exit status 0 and all that was recorded. The status is 1 where it could not go
    on (disk full, no frames from any camera) or recorded nothing. OUT/capture.yaml says what happened.
    """
    known_distances = _parse_distances(distances)
    if intrinsic and depth_bias:
        raise ConfigError("--intrinsic and --depth-bias: both given, one recording is for one of them. Run it twice")
    if wave is not None and (intrinsic or depth_bias or on_still or until_enough or interval is not None or count):
        raise ConfigError(
            "--wave records every frame while the board is carried; it goes without --intrinsic, --depth-bias, --on-still, "
            "--until-enough, --interval and --count. Leave them out"
        )
    if wave is not None and ((depth_frames or 1) > 1 or alternate_emitters):
        raise ConfigError(
            "--wave: the board moves, so that --depth-frames and --alternate-emitters do not apply. Leave them out"
        )
    if color_only and (depth_bias or snapshot or depth_frames or alternate_emitters or allow_unregistered):
        raise ConfigError(
            "--color-only leaves depth out; it goes without --depth-bias, --snapshot, --depth-frames, --alternate-emitters and "
            "--allow-unregistered. Leave them out"
        )
    if until_mm is not None and (intrinsic or depth_bias or snapshot or wave is not None or until_enough):
        raise ConfigError(
            "--until-mm records the board before the whole rig until the expected error is low enough; it goes without "
            "--intrinsic, --depth-bias, --snapshot, --wave and --until-enough. Leave them out"
        )
    if distances and not depth_bias:
        raise ConfigError("--distances belongs to --depth-bias. Add that, or leave it out")
    if snapshot and (intrinsic or depth_bias or wave is not None or on_still or until_enough or append):
        raise ConfigError(
            "--snapshot: one shot of the empty scene, without --intrinsic, --depth-bias, --wave, --on-still, --until-enough and "
            "--append. "
            "Leave them out"
        )
    named_board = board()
    if named_board is None and not append and (intrinsic or on_still or until_enough or until_mm is not None):
        asked = {"--intrinsic": intrinsic, "--on-still": on_still, "--until-enough": until_enough, "--until-mm": True}
        option = next(name for name, given in asked.items() if given)
        raise ConfigError(f"{option}: no board given; it needs one to look for. Add --board 9x6 --square 0.06")

    from rich.console import Console

    from rgbd_calib.capture.modes import ModeParams
    from rgbd_calib.capture.session import CaptureParams, capture
    from rgbd_calib.capture.shots import DepthParams
    from rgbd_calib.sensors.identity import parse_devices
    from rgbd_calib.views.coverage import CoverageParams

    wait_for_stillness = on_still or ((intrinsic or until_mm is not None) and interval is None)
    still = (wait_for_stillness or depth_bias) and not color_only
    usual_frames = SNAPSHOT_FRAMES if snapshot else STILL_FRAMES if still else 1
    mode = ModeParams(
        interval_s=0.5 if interval is None else interval,
        count=1 if snapshot and count is None else count,
        on_still=wait_for_stillness,
        until_enough=until_enough or (intrinsic and count is None),
    )
    params = CaptureParams(
        out,
        "intrinsic" if intrinsic else "depth-bias" if depth_bias else "wave" if wave is not None else "rig",
        mode,
        DepthParams(depth_frames or usual_frames, alternate_emitters),
        CoverageParams(judge_cameras=not pairs_only, judge_alone=until_mm is not None),
        named_board,  # type: ignore[arg-type]
        parse_devices(devices),
        known_distances,
        wave or 0.0,
        drivers,
        redist,
        append,
        auto_exposure,
        allow_unregistered,
        sync,
        settle,
        give_up,
        _parse_address(preview),
        until_mm,
        color_only,
    )
    result = capture(params, Console(stderr=True), _ask_distance)
    _summarize(out, result)


def _parse_address(text: str | None) -> tuple[str, int] | None:
    if text is None:
        return None
    from rgbd_calib.capture.preview import parse_address

    return parse_address(text)


def _parse_distances(text: str | None) -> tuple[float, ...]:
    try:
        distances_m = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        distances_m = (math.nan,)
    if not all(0 < d < 20 for d in distances_m):
        raise ConfigError(f"--distances {text}: metres between commas needed, such as 0.8,1.2,1.6")
    return distances_m


def _ask_distance(camera: str, proposed_m: float | None) -> float | None:
    """The next distance: asked of the person at the keyboard; without one, the proposed one at once."""
    from rgbd_calib.capture.signals import waiting_for_keyboard

    if not sys.stdin.isatty():
        if proposed_m is None:
            raise ConfigError("--depth-bias: nobody at the keyboard to say the distances. Add --distances 0.8,1.2,...")
        say(f"{camera}: wall at {proposed_m:.3f} m")
        return proposed_m
    with waiting_for_keyboard():
        if proposed_m is not None:
            answer = click.prompt(
                f"{camera}: stand it square to the wall, {proposed_m:.3f} m from lens to wall; Enter, or the true distance",
                default=f"{proposed_m}",
                show_default=False,
                err=True,
            )
        else:
            answer = click.prompt(
                f"{camera}: square to the wall; distance from lens to wall in metres (Enter: next camera)",
                default="",
                show_default=False,
                err=True,
            )
    return _parse_distances(answer)[0] if answer.strip() else None


def _summarize(out: Path, result: CaptureResult) -> None:
    tally = result.tally
    ended = "ended by Ctrl-C, " if result.status == "interrupted" else ""
    spread = f", cameras within {max(tally.spreads_ms):.1f} ms" if tally.spreads_ms and len(result.lost) > 1 else ""
    say(f"{out}: {ended}{result.frame_sets} frame sets{spread}")
    for camera, n in tally.absent.items():
        say(f"Warning: {camera}: missing in {n} of them; {out / 'capture.yaml'} says why")
    for camera, lost in result.lost.items():
        if any(lost.values()):
            words = {"color": "colour", "depth": "depth"}
            said = " and ".join(f"{n} {words[kind]}" for kind, n in lost.items())
            say(f"{camera}: {said} frames never came; the shots do without them")
    for camera, gaps in tally.not_written.items():
        n = sum(gap["frames"] for gap in gaps)
        say(
            f"Warning: {camera}: {n} frames dropped, writing was slower; {out / 'capture.yaml'} says between which stamps"
        )
    if result.error is None or not result.error.reached:
        for sentence in result.missing:
            say(f"Still missing: {sentence}")
    if result.error is not None:
        _say_error(out, result)


def _say_error(out: Path, result: CaptureResult) -> None:
    """What was expected of the rig, and what comes next."""
    error = result.error
    assert error is not None
    if not error.reached and not result.missing and not error.distrust:
        say(f"To lower the error: {error.limits}")
    if result.board_m:
        near_m, far_m = (f(own) for f, own in zip((min, max), zip(*result.board_m.values(), strict=True), strict=True))
        say(
            f"Depth is calibrated from {near_m:.1f} to {far_m:.1f} m, where the board was. Only if you need depth beyond that: record a "
            f"wall with --depth-bias into another folder, and give it to `calibrate --depth-bias`"
        )
    say(f"Expected error: {error.text}{': reached' if error.reached else ''}")
    say(f"Next: rgbd-calib calibrate {out} -o rig.yaml")
