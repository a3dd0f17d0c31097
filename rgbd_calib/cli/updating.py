"""`rgbd-calib calibrate --update`: one camera of a rig anew, or a rig in another world."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rgbd_calib.cli.options import progress, say, show
from rgbd_calib.errors import ConfigError

if TYPE_CHECKING:
    from rgbd_calib.pipeline.workers import Workers


def update(
    recording: Path,
    rig_path: Path,
    output: Path,
    only: str | None,
    world: str | None,
    snapshot: Path | None,
    intrinsics: Path | None,
    depth_bias: Path | None,
    corners: Path | None,
    config: Path | None,
    seed: int | None,
    workers: Workers,
) -> None:
    """Change the rig file `rig_path` by what RECORDING shows, and write it to `output`."""
    if sum(option is not None for option in (only, world, snapshot)) != 1:
        raise ConfigError(
            "--update: give one of --only CAMERA, which poses one camera anew by a board, --snapshot OLD, which corrects those that "
            "moved since that snapshot, and --world, which moves all of them"
        )
    if snapshot is not None:
        _by_snapshot(recording, rig_path, output, snapshot, config, seed)
        return
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig, write_rig
    from rgbd_calib.io.rig_update import write_update
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.depth_cameras import split
    from rgbd_calib.pipeline.detection import detections_from
    from rgbd_calib.pipeline.provenance import provenance_of
    from rgbd_calib.pipeline.update import update_camera
    from rgbd_calib.pipeline.world import rig_in_world

    settings = load_config(config, seed=seed)
    rig, opened = read_rig(rig_path), split(open_recording(recording))
    if only is None:
        assert world is not None
        found = (
            detections_from(opened, corners, settings.detect, workers, progress) if world.startswith("board:") else None
        )
        moved, boards = rig_in_world(rig, world, opened, found, settings)
        write_rig(output, moved, boards)
        _tell_poses(moved)
    else:
        found = detections_from(opened, corners, settings.detect, workers, progress)
        result = update_camera(
            rig,
            only,
            opened,
            settings,
            found,
            intrinsics=intrinsics,
            depth_bias=depth_bias,
            workers=workers,
            progress=progress,
        )
        provenance = {"only": only, **provenance_of(settings), "recording": str(recording)}
        write_update(rig_path, output, only, result.entry, result.report, provenance)
        own = result.report
        for view, why in (own.left_out or {}).items():
            say(f"{view} left out: {why}")
        if own.moved_mm is not None:
            show(f"{only}: moved by {own.moved_mm:.2f} mm and {own.turned_deg:.3f}°, posed by {own.views} views")
        else:
            show(f"{only}: added by {own.views} views")
        for pair, numbers in (own.alignment or {}).items():
            if numbers.median_mm is not None:
                show(f"{pair}: {numbers.median_mm:.2f} mm apart in the median, including single-reading depth noise")
    say(f"Wrote {output}")


def _by_snapshot(
    recording: Path, rig_path: Path, output: Path, snapshot: Path, config: Path | None, seed: int | None
) -> None:
    from rgbd_calib.cli.verify import snapshot_table
    from rgbd_calib.io.recording import open_recording
    from rgbd_calib.io.rig import read_rig
    from rgbd_calib.io.rig_update import write_updates
    from rgbd_calib.pipeline.config import load_config
    from rgbd_calib.pipeline.provenance import provenance_of
    from rgbd_calib.pipeline.snapshot import corrected_by, verify_snapshot
    from rgbd_calib.trust.snapshot import SnapshotParams

    rig, old = read_rig(rig_path), open_recording(snapshot)
    new = open_recording(recording)
    verdict = verify_snapshot(rig, new, old, SnapshotParams())
    for line in snapshot_table(verdict):
        show(line)
    changes = corrected_by(rig, verdict, new, old)
    provenance = {
        "snapshot": str(snapshot),
        **provenance_of(load_config(config, seed=seed)),
        "recording": str(recording),
    }
    write_updates(rig_path, output, changes, {name: provenance | {"only": name} for name in changes})
    for name, (_, report) in changes.items():
        show(f"{name}: corrected by {report.moved_mm:.2f} mm and {report.turned_deg:.3f}°")
    if not changes:
        show("No camera moved against the others: the poses stay as they are")
    say(f"Wrote {output}")


def _tell_poses(rig) -> None:  # type: ignore[no-untyped-def]
    for name, own in rig.cameras.items():
        x, y, z = own.T_world_color[:3, 3]
        show(f"{name}: at {x:+.4f} {y:+.4f} {z:+.4f} m")
