"""`rgbd-calib fuse`: all cameras' depth as one cloud, and pictures of it."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import (
    Number,
    give,
    json_option,
    output_option,
    overwrite_option,
    recording_argument,
    refuse_existing,
    say,
    within_range_option,
)
from rgbd_calib.errors import ConfigError

VIEWS = ("front", "back", "left", "right", "top", "oblique")


@click.command
@recording_argument
@click.option("--rig", "rig_path", type=click.Path(path_type=Path), required=True, help="The rig file.")
@click.option("--frame", help="The instant to fuse.  [default: the first that most cameras have depth in]")
@click.option(
    "--color",
    type=click.Choice(["image", "camera"]),
    default="image",
    show_default=True,
    help="As filmed, or one colour for each camera, which shows where they disagree.",
)
@click.option("--image", is_flag=True, help="Also write pictures: CLOUD.VIEW.png beside the cloud.")
@click.option(
    "--view",
    "views",
    type=click.Choice(VIEWS),
    multiple=True,
    help="Where the pictures are seen from; may be given again; implies --image.  [default: front, top]",
)
@click.option("--max-depth", "max_depth_m", type=Number(0, min_open=True), help="Leave out what is farther, metres.")
@within_range_option
@output_option("the cloud, a .ply file")
@overwrite_option
@json_option
def command(
    recording: Path,
    rig_path: Path,
    frame: str | None,
    color: str,
    image: bool,
    views: tuple[str, ...],
    max_depth_m: float | None,
    within_range: bool,
    output: Path,
    overwrite: bool,
) -> None:
    """Fuse all cameras' depth into one cloud, with pictures.

    One instant, in the world's frame, depth bias removed. Points on depth edges are left out. Surfaces that two cameras see should be one surface: with --color camera
    its colours mingle where the rig is right and lie side by side where it is not. Pictures show where clouds overlap.

    \b
    Examples:
      rgbd-calib fuse demo/extrinsic --rig demo/rig.yaml -o demo/cloud.ply
      rgbd-calib fuse demo/extrinsic --rig demo/rig.yaml --color camera --view top --view oblique -o demo/views.ply
    """
    if output.suffix.lower() != ".ply":
        raise ConfigError(f"{output}: a name that ends in .ply is needed. Try {output.with_suffix('.ply')}")
    pictures = {view: output.with_suffix(f".{view}.png") for view in views or (("front", "top") if image else ())}
    for path in (output, *pictures.values()):
        refuse_existing(path, overwrite)

    import numpy as np

    from rgbd_calib.io.pictures import write_picture
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.pipeline import fuse
    from rgbd_calib.pipeline.rig_inputs import common_cameras, left_out
    from rgbd_calib.report import splat

    rig = read_rig(rig_path)
    opened = open_recording(recording)
    if left_out(opened, rig):
        say(left_out(opened, rig))
    if frame is None:
        frame = fuse.fullest_frame(opened, common_cameras(opened, rig))
    params = fuse.FuseParams(np.inf if max_depth_m is None else max_depth_m, within_range)
    clouds = fuse.clouds_of(opened, rig, frame, params)

    legend = {name: splat.camera_color(i) for i, name in enumerate(rig.cameras)}
    points_m = np.concatenate([cloud.points_m for cloud in clouds])
    if color == "camera":
        colors = np.concatenate([np.full((len(c.points_m), 3), legend[c.camera], np.uint8) for c in clouds])
    else:
        colors = np.concatenate([cloud.colors for cloud in clouds])
    if not len(points_m):
        raise ConfigError(
            f"{recording}: frame {frame}: no depth is left. Choose another frame, or a larger --max-depth"
        )
    fuse.write_ply(output, points_m, colors)
    say(f"Frame {frame}: {len(points_m)} points of {len(clouds)} cameras -> {output}")
    for cloud in clouds:
        dropped = ", ".join(f"{count} {why}" for why, count in cloud.dropped.items() if count)
        notes = f"; left out: {dropped}" if dropped else ""
        if cloud.outside:
            notes += f"; {cloud.outside / len(cloud.points_m):.0%} outside the range of the bias's data, corrected less surely"
        say(f"  {cloud.camera}: {len(cloud.points_m)} points{notes}")
    if pictures:
        in_order = sorted(rig.cameras, key=lambda name: name != rig.reference)
        poses = [rig.cameras[name].T_world_color for name in in_order]
        shown = {c.camera: legend[c.camera] for c in clouds} if color == "camera" else {}
        focus_m = splat.seen_by_several([cloud.points_m for cloud in clouds])
        for view, path in pictures.items():
            picture = splat.render(points_m, colors, splat.viewpoint(view, poses, focus_m))
            write_picture(path, splat.with_legend(picture, shown))
            say(f"  seen from {view} -> {path}")
    give(
        {
            "output": str(output),
            "frame": frame,
            "points": len(points_m),
            "cameras": {
                cloud.camera: {"points": len(cloud.points_m), "left_out": cloud.dropped, "outside": cloud.outside}
                for cloud in clouds
            },
            "pictures": {view: str(path) for view, path in pictures.items()},
        }
    )
