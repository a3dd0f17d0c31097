"""`rgbd-calib refine`: the estimators on correspondences of any origin."""

from __future__ import annotations

import math
from pathlib import Path

import click

from rgbd_calib.cli.options import (
    Number,
    config_option,
    give,
    json_option,
    method_options,
    output_option,
    overwrite_option,
    refuse_existing,
    say,
    show,
)


@click.command()
@click.argument("source", type=click.Path(path_type=Path), metavar="CORRESPONDENCES|RIG")
@click.option("--intrinsics", type=click.Path(path_type=Path), help="intrinsics.yaml, or any rig file.")
@click.option(
    "--clouds",
    type=click.Path(path_type=Path),
    help="Refine the poses of a rig file by the clouds of this recording of any scene.",
)
@click.option(
    "--pose-sd",
    type=Number(0.01, 1000.0),
    metavar="MM",
    help="With --clouds: by how much the poses of RIG are thought to displace points at 2 m (RMS), on top of the covariance in "
    "its file.",
)
@click.option("--force", is_flag=True, help="With --clouds: write the rig even if it is not expected to be better.")
@output_option("rig.yaml")
@method_options(("init", "ba", "icp", "baicp+", "biobjective"))
@click.option("--strict", is_flag=True, help="Exit with status 1 if the self-checks fail. The rig is written.")
@json_option
@config_option
@overwrite_option
def command(
    source: Path,
    intrinsics: Path | None,
    clouds: Path | None,
    pose_sd: float | None,
    force: bool,
    output: Path,
    method: str | None,
    sigma_2d: float | None,
    sigma_3d: float | None,
    reference: str | None,
    seed: int | None,
    strict: bool,
    config: Path | None,
    overwrite: bool,
) -> None:
    """Pose the cameras from CORRESPONDENCES, a CSV of features that several cameras see, or refine RIG by clouds.

    Columns: camera,frame,feature,u_px,v_px,x_m,y_m,z_m - one row for each observation, u and v empty where there is only
    a 3D point, x, y, z (in the camera's frame) empty where there is only a pixel.

    The residuals are tested: against sigmas that are given, and part against part in time, over the image and the range.

    --clouds starts from a rig file and needs neither board nor features: surfaces that two cameras see from the same side,
    point to plane, weighed against the rig's own covariance. Errors of depth that all points of a camera share are counted.
    Lenses and depth stay. Refused unless the expected error becomes smaller, and where the scene leaves a camera free to move.

    \b
    Examples:
      rgbd-calib calibrate demo/extrinsic --intrinsics demo/truth.yaml --correspondences c.csv -o rig.yaml
      rgbd-calib refine c.csv --intrinsics demo/truth.yaml -o refined.yaml
      rgbd-calib refine c.csv --intrinsics demo/truth.yaml --sigma-2d 0.3 --sigma-3d 0.005 -o known_w.yaml
      rgbd-calib refine rig.yaml --clouds empty --pose-sd 5 -o rig2.yaml
    """
    given = {"--intrinsics": intrinsics, "--method": method, "--sigma-2d": sigma_2d, "--sigma-3d": sigma_3d}
    given |= {"--reference": reference, "--strict": strict or None}
    if clouds is not None and (wrong := [name for name, value in given.items() if value is not None]):
        raise click.UsageError(f"--clouds starts from a rig file, and takes no {', '.join(wrong)}")
    if clouds is None and (pose_sd is not None or force):
        raise click.UsageError("--pose-sd and --force need --clouds RECORDING")
    if clouds is None and intrinsics is None:
        raise click.UsageError("give --intrinsics FILE with CORRESPONDENCES, or --clouds RECORDING with RIG")
    refuse_existing(output, overwrite)
    if clouds is not None:
        _by_clouds(source, clouds, pose_sd, force, output, config)
        return
    assert intrinsics is not None
    from dataclasses import replace

    from rgbd_calib.io.correspondences import read_correspondences
    from rgbd_calib.io.rig import write_rig
    from rgbd_calib.pipeline.checked_views import reference_of
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.prepare import given_intrinsics
    from rgbd_calib.pipeline.provenance import provenance_of
    from rgbd_calib.pipeline.refine_correspondences import refine_correspondences
    from rgbd_calib.pipeline.summary import numbers_of
    from rgbd_calib.report.numbers import verdict_of

    settings = load_config(
        config,
        method=method,
        reference=reference,
        seed=seed,
        refinement__sigma_2d_px=sigma_2d,
        refinement__sigma_3d_m=sigma_3d,
    )
    if settings.method == "bundle":
        settings = replace(settings, method="biobjective")
    data = read_correspondences(source)
    lenses = given_intrinsics(intrinsics, data.cameras)
    rig, refined = refine_correspondences(data, lenses, settings, reference_of(settings, data.cameras))
    origin = {"correspondences": str(source), "intrinsics": str(intrinsics)}
    rig = replace(rig, provenance={**provenance_of(settings), **origin})
    write_rig(output, rig)
    for name, camera in rig.cameras.items():
        x, y, z = camera.T_world_color[:3, 3]
        show(f"{name}: at {x:+.4f} {y:+.4f} {z:+.4f} m")
    if refined is not None:
        say(
            f"sigma_2D {refined.sigma_2d_px:.3f} px, sigma_3D {1e3 * refined.sigma_3d_m:.2f} mm, w {refined.w:.3g}; "
            f"{refined.message}"
        )
    say(f"Wrote {output}")
    verdict = verdict_of(rig, None)
    say(f"Verdict: {verdict}", always=verdict.level in ("poor", "untrusted"))
    give(numbers_of(rig, verdict, None))
    for own in rig.quality.self_check.findings if rig.quality.self_check is not None else ():
        say(f"  {own.text}. {own.advice}.")
    if strict and verdict.level == "untrusted":
        click.get_current_context().exit(1)


def _by_clouds(
    rig_path: Path, recording: Path, pose_sd_mm: float | None, force: bool, output: Path, config: Path | None
) -> None:
    from dataclasses import replace

    from rgbd_calib.errors import CalibrationError
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig, write_rig
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.provenance import provenance_of
    from rgbd_calib.pipeline.refine_clouds import refine_by_clouds

    rig = read_rig(rig_path)
    found = refine_by_clouds(rig, open_recording(recording), None if pose_sd_mm is None else pose_sd_mm / 1e3)
    for pair, patches in found.patches.items():
        say(f"{pair}: {patches} patches of surface in common")
    if found.apart:
        say(f"no surface in common with another camera, pose as it was: {', '.join(found.apart)}")
    for name, (moved_m, turned_rad) in found.moved.items():
        if name != rig.reference:
            show(f"{name}: moved by {1e3 * moved_m:.2f} mm and {math.degrees(turned_rad):.3f}°")
    show(
        f"Expected error: {found.before.mean_mm:.2f} mm before, {found.after.mean_mm:.2f} mm after; clouds and rig are "
        f"{math.sqrt(found.surprise):.1f} standard deviations apart, 1 is usual"
    )
    give(
        {
            "refused": list(found.refused),
            "expected_before_mm": found.before.mean_mm,
            "expected_after_mm": found.after.mean_mm,
            "surprise": found.surprise,
            "patches": dict(found.patches),
            "free": {name: list(free) for name, free in found.free.items()},
            "no_surface_in_common": list(found.apart),
            "cameras": {
                name: {"moved_mm": 1e3 * m, "turned_deg": math.degrees(t)} for name, (m, t) in found.moved.items()
            },
        }
    )
    if found.refused and not force:
        raise CalibrationError(f"{recording}: refused: {'. '.join(found.refused)}")
    for why in found.refused:
        say(f"Written because of --force, although {why}", always=True)
    changes = {"by": "clouds", "rig": str(rig_path), "recording": str(recording), "pose_sd_mm": pose_sd_mm}
    made = found.rig.provenance
    updates = [*made.get("updates", []), {**provenance_of(load_config(config)), **changes}]
    write_rig(output, replace(found.rig, provenance=made | {"updates": updates}))
    say(f"Wrote {output}")
