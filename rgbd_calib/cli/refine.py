"""`rgbd-calib refine`: the estimators on correspondences of any origin."""

from __future__ import annotations

from pathlib import Path

import click

from rgbd_calib.cli.options import (
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
@click.argument("correspondences", type=click.Path(path_type=Path))
@click.option("--intrinsics", type=click.Path(path_type=Path), required=True, help="intrinsics.yaml, or any rig file.")
@output_option("rig.yaml")
@method_options(("init", "ba", "icp", "baicp+", "biobjective"))
@click.option("--strict", is_flag=True, help="Exit with status 1 if the self-checks fail. The rig is written.")
@json_option
@config_option
@overwrite_option
def command(
    correspondences: Path,
    intrinsics: Path,
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
    """Pose the cameras from CORRESPONDENCES, a CSV of features that several cameras see.

    Columns: camera,frame,feature,u_px,v_px,x_m,y_m,z_m - one row for each observation, u and v empty where there is only
    a 3D point, x, y, z (in the camera's frame) empty where there is only a pixel.

    The residuals are tested: against sigmas that are given, and part against part in time, over the image and the range.

    \b
    Examples:
      rgbd-calib calibrate demo/extrinsic --intrinsics demo/truth.yaml --correspondences c.csv -o rig.yaml
      rgbd-calib refine c.csv --intrinsics demo/truth.yaml -o refined.yaml
      rgbd-calib refine c.csv --intrinsics demo/truth.yaml --sigma-2d 0.3 --sigma-3d 0.005 -o known_w.yaml
    """
    refuse_existing(output, overwrite)
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
    data = read_correspondences(correspondences)
    lenses = given_intrinsics(intrinsics, data.cameras)
    rig, refined = refine_correspondences(data, lenses, settings, reference_of(settings, data.cameras))
    origin = {"correspondences": str(correspondences), "intrinsics": str(intrinsics)}
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
