"""Feed every reader of foreign files with damaged and hostile ones: hypothesis by structure, atheris by bytes."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from hashlib import sha256
from pathlib import Path
from typing import Any

import click
from fuzz_damage import PER_EXAMPLE, damaged, with_checksums

SEEDS = Path(__file__).parents[1] / "tests" / "builders" / "fuzz_seeds"
BY_BYTES = (
    "YAML bytes",
    "images",
    "ROS 1 bag",
    "MCAP",
    "ROS 2 db3",
    "RealSense db3",
    "Orbbec bag",
    "calibrations",
    "COLMAP",
    "videos",
    "imported images",
)
RECORDED = ("Azure mkv", "RealSense bag")
BY_STRUCTURE = (
    "dataset.yaml",
    "rig.yaml",
    "config.yaml",
    "capture.yaml",
    "board.yaml",
    "timing.yaml",
    "calibration trees",
    "scene_camera.json",
    "corners.csv",
    "correspondences.csv",
    "residuals.csv",
    "timestamps.csv",
    "distances.csv",
    "caliscope timestamps.csv",
    "rgb.txt",
)
SAY_S = 10.0
HANGS_S = 300.0
"""Without a further input, a reader hangs where no signal reaches it."""


@click.command()
@click.option("--inputs", default=100_000, show_default=True, help="For each parser.")
@click.option("--minutes", default=60.0, show_default=True, help="For all parsers together, in equal parts.")
@click.option("--seed", default=0, show_default=True)
@click.option("--only", multiple=True, help="Parsers to feed.  [default: all]")
@click.option("--recordings", type=click.Path(path_type=Path), help="Folder with real recordings, to be damaged too.")
@click.option("--state", type=click.Path(path_type=Path), help="File of the counts; a run with it goes on from there.")
@click.option("--save", type=click.Path(path_type=Path), help="Folder for the inputs that were a fault.")
@click.option("--json", "as_json", is_flag=True)
@click.option("--child", hidden=True, type=click.Path(path_type=Path), help="File for the result of one parser.")
def main(
    inputs: int, minutes: float, seed: int, only: tuple[str, ...], recordings: Path | None, state: Path | None,
    save: Path | None, as_json: bool, child: Path | None,
) -> None:  # fmt: skip
    """Print, for each parser: inputs tried, faults found, mended and left; progress goes to stderr.

    A fault is an exception that is not for users, a warning, more than 10 s or 1 GiB, or the end of the process. Mended
    are those that tests/builders/fuzz_seeds holds and that do no harm any more.
    """
    if child is not None:
        run = _by_structure if only[0] in BY_STRUCTURE else _by_bytes
        run(only[0], inputs, 60 * minutes, seed, child, recordings)
        return
    names = only or (*BY_STRUCTURE, *BY_BYTES, *(RECORDED if recordings else ()))
    if set(names) - set(BY_STRUCTURE) and importlib.util.find_spec("atheris") is None:
        raise click.UsageError("the package atheris is missing. Install it: pip install -e '.[fuzz]'")
    known = json.loads(state.read_text()) if state is not None and state.exists() else {}
    rows, end_s = [], time.monotonic() + 60 * minutes
    for n, name in enumerate(names):
        feed = _Feed(name, inputs, recordings, known.get(name, {"seed": seed}))
        feed.run(min(end_s, time.monotonic() + (end_s - time.monotonic()) / (len(names) - n)))
        feed.keep(save)
        known[name] = feed.state
        if state is not None:
            state.write_text(json.dumps(known))
        rows.append(feed.row())
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo(
        f"{'parser':26}{'engine':12}{'inputs':>8}{'accepted':>10}{'refused':>9}{'found':>7}{'mended':>8}{'left':>6}{'s':>7}"
    )
    for row in rows:
        click.echo(
            f"{row['parser']:26}{row['engine']:12}{row['inputs']:8}{row['accepted']:10}{row['refused']:9}"
            f"{row['found']:7}{row['mended']:8}{row['left']:6}{row['seconds']:7.0f}"
        )
        for what, count in row["faults"].items():
            click.echo(f"    {count} x {what}")
    click.echo(f"{sum(row['inputs'] for row in rows)} inputs, {sum(row['left'] for row in rows)} faults left")
    sys.exit(any(row["left"] for row in rows))


class _Feed:
    """One parser in processes of its own, until all inputs were tried or the time is over; one that dies is a fault."""

    def __init__(self, name: str, inputs: int, recordings: Path | None, state: dict[str, Any]) -> None:
        self._name, self._inputs, self._recordings = name, inputs, recordings
        self._seed = int(state["seed"])
        self._counts: Counter[str] = Counter(state.get("counts", {}))
        self._faults: dict[str, tuple[int, str]] = {
            what: (n, data) for what, (n, data) in state.get("faults", {}).items()
        }
        self._seconds = float(state.get("seconds", 0))

    @property
    def state(self) -> dict[str, Any]:
        """What :class:`_Feed` goes on from."""
        return {"seed": self._seed, "counts": self._counts, "faults": self._faults, "seconds": self._seconds}

    def run(self, end_s: float) -> None:
        start = time.monotonic()
        while self._counts.total() < self._inputs and time.monotonic() < end_s:
            self._process(end_s)
            self._seed += 1
        self._seconds += time.monotonic() - start

    def _process(self, end_s: float) -> None:
        from fuzz_parsers import scratch

        result = scratch() / "result.json"
        left, minutes = self._inputs - self._counts.total(), max(end_s - time.monotonic(), 1) / 60
        args = ["--only", self._name, "--inputs", left, "--minutes", minutes, "--seed", self._seed, "--child", result]
        args += ["--recordings", self._recordings] if self._recordings else []
        log = result.with_suffix(".log")
        with log.open("w") as stream:
            process = subprocess.Popen([sys.executable, __file__, *map(str, args)], stdout=stream, stderr=stream)
        current, hung = result.parent / "current", False
        while not hung and process.poll() is None:
            try:
                process.wait(SAY_S)
            except subprocess.TimeoutExpired:
                hung = current.exists() and time.time() - current.stat().st_mtime > HANGS_S
                found = json.loads(result.read_text()) if result.exists() else {"counts": {}, "faults": {}}
                done = self._counts.total() + sum(found["counts"].values())
                click.echo(f"{self._name}: {done} inputs, {len(self._faults | found['faults'])} faults", err=True)
        process.kill()
        status = process.wait()
        if not current.exists():
            raise click.ClickException(f"{self._name} could not be fed: {log.read_text().strip()[-500:]}")
        found = json.loads(result.read_text()) if result.exists() else {"counts": {}, "faults": {}}
        self._counts.update(found["counts"])
        for what, (n, data) in found["faults"].items():
            self._add(what, n, data)
        if status != 0:
            said = "hangs" if hung else f"the process ended with {status}: {log.read_text().strip()[-200:]}"
            self._counts["fault"] += 1
            self._add(said, 1, current.read_bytes().hex())
        shutil.rmtree(result.parent)

    def _add(self, what: str, n: int, data: str) -> None:
        before, first = self._faults.get(what, (0, data))
        self._faults[what] = before + n, min(first, data, key=len)

    def keep(self, folder: Path | None) -> None:
        """Write the inputs that were a fault."""
        for _, data in self._faults.values() if folder else ():
            folder.mkdir(parents=True, exist_ok=True)  # type: ignore[union-attr]
            whole = bytes.fromhex(data)
            (folder / f"{slug(self._name)}-{sha256(whole).hexdigest()[:8]}").write_bytes(whole)  # type: ignore[operator]

    def row(self) -> dict[str, Any]:
        kept = len(list(SEEDS.glob(f"{slug(self._name)}-*")))
        return {
            "parser": self._name,
            "engine": "hypothesis" if self._name in BY_STRUCTURE else "atheris",
            "inputs": self._counts.total(),
            "accepted": self._counts["accepted"],
            "refused": self._counts["refused"],
            "found": kept + len(self._faults),
            "mended": kept,
            "left": len(self._faults),
            "faults": {what: n for what, (n, _) in self._faults.items()},
            "seconds": self._seconds,
        }


def slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


class _Tally:
    """Counts of one child, written every second: a process that dies leaves them, and the input that it died of."""

    def __init__(self, parser: Any, result: Path, inputs: int, seconds: float) -> None:
        self._parser, self._result = parser, result
        self._inputs, self._end_s, self._written_s = inputs, time.monotonic() + seconds, 0.0
        self.counts: Counter[str] = Counter()
        self._faults: dict[str, tuple[int, str]] = {}

    @property
    def done(self) -> bool:
        return self.counts.total() >= self._inputs or time.monotonic() > self._end_s

    def try_one(self, data: bytes) -> None:
        from fuzz_parsers import attempt

        (self._result.parent / "current").write_bytes(data)
        outcome = attempt(self._parser, data)
        self.counts[outcome.status] += 1
        if outcome.status == "fault":
            n, first = self._faults.get(outcome.what, (0, data.hex()))
            self._faults[outcome.what] = n + 1, min(first, data.hex(), key=len)
        if time.monotonic() - self._written_s > 1 or self.done:
            self.write()

    def write(self) -> None:
        whole = self._result.with_suffix(".new")
        whole.write_text(json.dumps({"counts": self.counts, "faults": self._faults}))
        whole.replace(self._result)
        self._written_s = time.monotonic()


def _by_structure(name: str, inputs: int, seconds: float, seed: int, result: Path, recordings: Path | None) -> None:
    import hypothesis
    from fuzz_parsers import parsers
    from hypothesis import HealthCheck, Phase, settings

    parser = parsers(result.parent, recordings)[name]
    tally = _Tally(parser, result, inputs, seconds)
    quiet = settings(
        max_examples=min(20, -(-inputs // PER_EXAMPLE)),  # at a time: hypothesis goes on when the time is over
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    strategy = damaged(parser)

    def try_all(inputs_: list[bytes]) -> None:
        for data in inputs_:
            if not tally.done:
                tally.try_one(data)

    while not tally.done:
        hypothesis.seed(seed)(quiet(hypothesis.given(strategy)(try_all)))()
        seed += 1_000_003
    tally.write()


def _by_bytes(name: str, inputs: int, seconds: float, seed: int, result: Path, recordings: Path | None) -> None:
    import atheris

    with atheris.instrument_imports(include=["rgbd_calib.io", "PIL", "rosbags"]):
        from fuzz_parsers import parsers

        parser = parsers(result.parent, recordings)[name]
    tally = _Tally(parser, result, inputs, seconds)
    corpus = result.parent / "corpus"
    corpus.mkdir()
    for i, data in enumerate(parser.seeds):
        (corpus / str(i)).write_bytes(data)

    def mutate(data: bytes, most: int, number: int) -> bytes:
        mutated = atheris.Mutate(data, most)
        return with_checksums(mutated)[:most] if number % 4 else mutated

    longest = 2 * max(map(len, parser.seeds))
    options = [
        f"-runs={inputs}",
        f"-max_total_time={max(1, round(seconds))}",
        f"-seed={seed + 1}",
        f"-max_len={longest}",
        "-timeout=0",
        "-rss_limit_mb=0",
        "-verbosity=0",
    ]
    atheris.Setup(["fuzz", *options, str(corpus)], tally.try_one, custom_mutator=mutate if name == "images" else None)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
