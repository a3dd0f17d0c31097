"""Options of `simulate --snapshot`: what changes between the two snapshots."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from rgbd_calib.cli.options import Number

if TYPE_CHECKING:
    from rgbd_calib.simulation.changes import SceneChange


def scene_change_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options, given to the command as `scene_change`: call it for a SceneChange, or None without --snapshot."""

    @click.option(
        "--snapshot",
        is_flag=True,
        help="Instead: two recordings of the empty scene, OUT/old and OUT/new, and OUT/truth.yaml.",
    )
    @click.option(
        "--move",
        "moves",
        multiple=True,
        metavar="CAMERA:X,Y,Z,RX,RY,RZ",
        help="With --snapshot: motion of a camera in its own frame, mm and degrees (repeat).",
    )
    @click.option(
        "--objects", type=click.IntRange(0, 14), default=0, help="With --snapshot: pieces of furniture moved."
    )
    @click.option("--people", type=click.IntRange(0, 20), default=0, help="With --snapshot: people in the new one.")
    @click.option(
        "--light",
        type=Number(0.05, 10.0),
        default=1.0,
        help="With --snapshot: illumination of the new one relative to the old.",
    )
    @click.option(
        "--warm-up",
        metavar="PERCENT,MM",
        default="0,0",
        help="With --snapshot: change of the measured depth, scale and offset.",
    )
    @click.option(
        "--surroundings",
        type=click.Choice(["room", "wall", "floor"]),
        default="room",
        show_default=True,
        help="With --snapshot: the furnished room, one painted wall, or bare planks.",
    )
    @click.option(
        "--depth-frames",
        type=click.IntRange(1, 1000),
        default=None,
        help="Readings that each depth image is the mean of [default: 1]; with --snapshot depth images of each camera "
        "[default: 30].",
    )
    @wraps(command)
    def with_change(
        *args: Any,
        snapshot: bool,
        moves: tuple[str, ...],
        objects: int,
        people: int,
        light: float,
        warm_up: str,
        surroundings: str,
        depth_frames: int | None,
        cameras: int,
        **options: Any,
    ) -> Any:
        asked = bool(moves) or objects or people or light != 1.0 or warm_up != "0,0" or surroundings != "room"
        if asked and not snapshot:
            raise click.UsageError("--move, --objects, --people, --light, --warm-up and --surroundings need --snapshot")

        def scene_change() -> tuple[SceneChange, int] | None:
            from rgbd_calib.simulation.changes import SceneChange

            if not snapshot:
                return None
            percent, offset_mm = _numbers("--warm-up", warm_up, 2)
            twists = dict(_move(text, cameras) for text in moves)
            change = SceneChange(
                twists, objects, people, light, percent / 100, offset_mm / 1e3, surroundings  # type: ignore[arg-type]
            )  # fmt: skip
            return change, depth_frames or 30

        readings = 1 if snapshot or depth_frames is None else depth_frames
        if readings > 1 and options["wave"] is not None:
            raise click.UsageError("--wave: the board moves, so that --depth-frames does not apply. Leave it out")
        return command(*args, cameras=cameras, scene_change=scene_change, depth_readings=readings, **options)

    return with_change


def _move(text: str, cameras: int) -> tuple[str, Any]:
    """Camera and twist (6,), rad and m, of the option."""
    import numpy as np

    camera, colon, values = text.partition(":")
    names = [f"C{i + 1}" for i in range(cameras)]
    if not colon or camera not in names:
        raise click.UsageError(
            f"--move {text}: CAMERA:X,Y,Z,RX,RY,RZ expected, with a camera of {', '.join(names)}; such as C2:10,0,-5,0,0.5,0"
        )
    numbers = np.array(_numbers(f"--move {camera}", values, 6))
    return camera, np.concatenate([np.radians(numbers[3:]), numbers[:3] / 1e3])


def _numbers(where: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise click.UsageError(f"{where}: {count} finite numbers separated by commas expected, {text!r} found")
    return values
