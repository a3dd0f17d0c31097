"""Feed `import` with damaged .oni files: the vendor's library dies of many, and the program must not.

Apart from `fuzz.py`, since each file needs a process of its own (0.1 s and more).
"""

from __future__ import annotations

import json
import random
import shutil
import sys
import time
from collections import Counter
from pathlib import Path

import click
from fuzz_parsers import Parser as Fed
from fuzz_parsers import attempt, scratch

from rgbd_calib.sensors import oni_player
from rgbd_calib.sensors.oni_file import OniFile
from rgbd_calib.sensors.openni2 import find_library

RECORD = b"NIR\0"
HEADER_BYTES = 28


@click.command()
@click.argument("recording", type=click.Path(exists=True, path_type=Path))
@click.option("--inputs", default=2000, show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--save", type=click.Path(path_type=Path), help="Folder for the inputs that were a fault.")
@click.option("--json", "as_json", is_flag=True)
def main(recording: Path, inputs: int, seed: int, save: Path | None, as_json: bool) -> None:
    """Damage RECORDING, an .oni file, and print how often it was accepted, refused, and a fault."""
    # fork instead of spawn: Python and its modules are there already, and the runtime is loaded in the child anyway
    oni_player.START = "fork"
    oni_player.END_S = 0.2
    folder = scratch()
    redist = _redist_for_files(folder / "redist")
    path, whole = folder / "fuzzed.oni", recording.read_bytes()

    def read(data: bytes) -> object:
        path.write_bytes(data)
        source = OniFile(path, "C1", redist)
        return source.stamps(), sum(1 for _ in source.pictures(lambda *picture: True))

    parser = Fed("oni", read, (whole,))
    records = [at for at in range(len(whole)) if whole.startswith(RECORD, at)]
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    refusals: Counter[str] = Counter()
    start = time.monotonic()
    for _ in range(inputs):
        data = _damaged(rng, whole, records)
        outcome = attempt(parser, data)
        counts[outcome.status] += 1
        if outcome.status == "fault":
            faults[outcome.what] += 1
            if save is not None:
                save.mkdir(parents=True, exist_ok=True)
                (save / f"oni-{faults.total()}").write_bytes(data)
        if outcome.status == "refused":
            refusals[
                next((w for w in ("crashed", "hangs", "damaged", "does not open") if w in outcome.what), "other")
            ] += 1
    shutil.rmtree(folder)
    row = {"parser": "oni", "inputs": inputs, **counts, "faults": faults, "refusals": refusals}
    row["seconds"] = round(time.monotonic() - start)
    click.echo(json.dumps(row, indent=1) if as_json else ", ".join(f"{key} {value}" for key, value in row.items()))
    sys.exit(bool(faults))


def _redist_for_files(folder: Path) -> Path:
    """The runtime with its driver for files alone: the others look for cameras, which takes a second."""
    there, library = find_library(None)
    drivers = folder / "OpenNI2" / "Drivers"
    drivers.mkdir(parents=True)
    (folder / library).symlink_to(there / library)
    for driver in (there / "OpenNI2" / "Drivers").glob("libOniFile.so*"):
        (drivers / driver.name).symlink_to(driver)
    return folder


def _damaged(rng: random.Random, whole: bytes, records: list[int]) -> bytes:
    """Cut, or with a few bytes changed: in the first records, in any record's header, or anywhere."""
    how = rng.choice(("cut", "start", "start", "header", "header", "anywhere"))
    if how == "cut":
        return whole[: rng.randrange(len(whole))]
    data = bytearray(whole)
    for _ in range(rng.choice((1, 2, 5))):
        at = rng.randrange(1000) if how == "start" else rng.randrange(len(data))
        at = rng.choice(records) + rng.randrange(HEADER_BYTES) if how == "header" else at
        data[min(at, len(data) - 1)] = rng.choice((0, 127, 128, 255, rng.randrange(256)))
    return bytes(data)


if __name__ == "__main__":
    main()
