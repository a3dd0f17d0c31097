"""How many small faults, sown into geometry and the rooms of the method, the tests find: what a test file is worth is what it notices.

    python scripts/study_mutations.py --mutants 15 --survivors survivors.txt

cosmic-ray (chosen because a session is a plain database, from which a sample can be drawn) changes an operator, a number or
a condition at a time in a copy of the repository, and runs the tests that are meant to guard that module.
"""

from __future__ import annotations

import json
import os
import random
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from rgbd_calib.cli.options import progress

ROOT = Path(__file__).parents[1]
GUARDS = {
    "geometry/so3.py": "test_se3.py test_camera.py",
    "geometry/se3.py": "test_se3.py",
    "geometry/camera.py": "test_camera.py",
    "geometry/plane.py": "test_plane.py",
    "geometry/align.py": "test_se3.py test_plane.py",
    "geometry/resection.py": "test_resection.py",
    "views/association.py": "test_association.py",
    "views/board_pose.py": "test_board_pose.py",
    "views/correspondence.py": "test_correspondence.py",
    "views/coverage.py": "test_coverage.py",
    "cameras/depth_bias.py": "test_depth_bias.py",
    "rig/initialization.py": "test_initialization.py",
    "cameras/intrinsics.py": "test_intrinsics.py",
    "views/plane_filter.py": "test_plane_filter.py",
    "trust/uncertainty.py": "test_uncertainty.py",
    "cameras/wall.py": "test_wall.py",
    "views/detect/depth.py": "test_detect.py",
    "views/detect/subpixel.py": "test_detect.py",
    "geometry/linear.py": "test_bundle.py",
    "rig/common_errors.py": "test_bundle_common_errors.py",
    "rig/outliers.py": "test_bundle.py",
    "rig/problem.py": "test_bundle.py",
    "rig/reweight.py": "test_bundle.py",
    "rig/solve.py": "test_bundle.py",
    "rig/biobjective/groups.py": "test_refinement_solver.py",
    "rig/biobjective/kernels.py": "test_refinement_solver.py",
    "rig/biobjective/moments.py": "test_refinement_solver.py",
    "rig/biobjective/solver.py": "test_refinement_solver.py test_refinement.py",
    "rig/biobjective/statistics.py": "test_refinement.py",
    "rig/biobjective/terms.py": "test_refinement_solver.py test_refinement.py",
    "trust/displacement/view_fit.py": "test_displacement.py",
    "views/doctor/measures.py": "test_doctor.py",
}
EQUIVALENT = "operator_name like '%BitOr%' or operator_name like '%Decorator%'"
"""X | Y stands in annotations, which nothing evaluates; and a dataclass without its decorator is no fault of a number."""


@click.command()
@click.option("--mutants", default=15, show_default=True, help="Of each module, drawn at random.")
@click.option("--seed", default=0, show_default=True)
@click.option("--timeout", default=300.0, show_default=True, help="Seconds after which the tests count as failed.")
@click.option("--module", "only", multiple=True, type=click.Choice(list(GUARDS)), help="[default: all]")
@click.option("--survivors", type=click.Path(path_type=Path), help="Write what no test noticed here.")
@click.option("--json", "as_json", is_flag=True, help="Print the rows as JSON.")
def main(mutants: int, seed: int, timeout: float, only: tuple[str, ...], survivors: Path | None, as_json: bool) -> None:
    """Score the tests of geometry and the rooms of the method by mutants."""
    modules = only or tuple(GUARDS)
    rows, left = [], []
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "copy"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(copy)], check=True)
        for module in progress(modules, len(modules), "modules"):
            row, unnoticed = score(module, copy, Path(name), mutants, seed, timeout)
            rows.append(row)
            left += unnoticed
            click.echo(json.dumps(row), err=True)
            if survivors:
                survivors.write_text("\n\n".join(left), encoding="utf-8")
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo("| module | mutants possible | tried | found | score |\n|---|---|---|---|---|")
    for row in rows:
        click.echo(f"| {row['module']} | {row['possible']} | {row['tried']} | {row['found']} | {row['score']:.0%} |")
    tried, found = (sum(row[key] for row in rows) for key in ("tried", "found"))
    click.echo(f"| all | {sum(row['possible'] for row in rows)} | {tried} | {found} | {found / tried:.0%} |")


def score(
    module: str, copy: Path, folder: Path, mutants: int, seed: int, timeout: float
) -> tuple[dict[str, object], list[str]]:
    """One row, and the differences that no test noticed."""
    tests = " ".join(
        str(path.relative_to(copy)) for test in GUARDS[module].split() for path in (copy / "tests").rglob(test)
    )
    config, session = folder / "config.toml", folder / f"{module.replace('/', '.')}.sqlite"
    command = f"{sys.executable} -m pytest -x -q -p no:cacheprovider -m 'not slow' {tests}"
    config.write_text(
        f'[cosmic-ray]\nmodule-path = "rgbd_calib/{module}"\ntimeout = {timeout}\nexcluded-modules = []\n'
        f'test-command = "{command}"\n[cosmic-ray.distributor]\nname = "local"\n',
        encoding="utf-8",
    )
    environment = os.environ | {
        "PYTHONPATH": str(copy),
        "OMP_NUM_THREADS": "1",
        "RGBD_CALIB_TEST_DATA": str(ROOT.parent / "shared" / "data"),
    }
    cosmic_ray = [str(Path(sys.executable).parent / "cosmic-ray")]
    subprocess.run([*cosmic_ray, "init", str(config), str(session)], cwd=copy, env=environment, check=True)
    with sqlite3.connect(session) as db:
        order = "start_pos_row, start_pos_col, operator_name, occurrence"
        query = f"select job_id from mutation_specs where not ({EQUIVALENT}) order by {order}"
        jobs = [job for (job,) in db.execute(query)]
        kept = set(random.Random(seed).sample(jobs, min(mutants, len(jobs))))
        for table in ("work_items", "mutation_specs"):
            marks = ",".join("?" * len(kept))
            db.execute(f"delete from {table} where job_id not in ({marks})", tuple(kept))
    subprocess.run([*cosmic_ray, "exec", str(config), str(session)], cwd=copy, env=environment, check=True)
    with sqlite3.connect(session) as db:
        results = list(db.execute("select test_outcome, diff from work_results order by job_id"))
    unnoticed = [diff for outcome, diff in results if outcome.upper() == "SURVIVED"]
    found = len(results) - len(unnoticed)
    row = {"module": module, "possible": len(jobs), "tried": len(results), "found": found}
    return row | {"score": found / max(len(results), 1)}, unnoticed


if __name__ == "__main__":
    main()
