"""Feed every reader of foreign files with damaged and hostile ones: hypothesis by structure, atheris by bytes."""

from __future__ import annotations

import copy
import json
import random
import shutil
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import click

SEEDS = Path(__file__).parents[1] / "tests" / "builders" / "fuzz_seeds"
PER_EXAMPLE = 100
BY_BYTES = (
    "YAML bytes",
    "images",
    "ROS 1 bag",
    "MCAP",
    "ROS 2 db3",
    "RealSense db3",
    "Orbbec bag",
    "calibrations",
    "scene_camera.json",
    "videos",
    "imported images",
)
BY_STRUCTURE = (
    "dataset.yaml",
    "rig.yaml",
    "config.yaml",
    "capture.yaml",
    "corners.csv",
    "correspondences.csv",
    "residuals.csv",
    "timestamps.csv",
    "distances.csv",
    "rgb.txt",
)
HOSTILE: tuple[Any, ...] = (
    *("", ".", "..", "../x", "/etc/passwd", "C:\\x", "a/b", "a\x00b", "\x1b[2J", "a\nb", "x" * 5000, "\ud7ff", "1e999"),
    *("nan", ".inf", "-1", "0x10", "1_0", "１", "null", "*a", "!!int 3", "'", '"', ",", "bundle", "C1", "000000"),
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2**31,
        2**63,
        10**400,
        float("nan"),
        float("inf"),
        -float("inf"),
        1e308,
        5e-324,
        1e13,
    ),
    *([], {}, [[]], [{}], {"": ""}, [1.0] * 16, [[1.0] * 4] * 4, [0] * 2000, {"a": {"b": {"c": 1}}}),
)
BOMB = "a0: &a0 [1,1,1,1,1,1,1,1,1]\n" + "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9))


@click.command()
@click.option("--inputs", default=100_000, show_default=True, help="For each parser.")
@click.option("--seed", default=0, show_default=True)
@click.option("--only", multiple=True, help="Parsers to feed.  [default: all]")
@click.option("--save", type=click.Path(path_type=Path), help="Folder for the inputs that were a fault.")
@click.option("--json", "as_json", is_flag=True)
@click.option("--child", hidden=True, type=click.Path(path_type=Path), help="File for the result of one parser.")
def main(inputs: int, seed: int, only: tuple[str, ...], save: Path | None, as_json: bool, child: Path | None) -> None:
    """Print, for each parser: inputs tried, faults found, mended and left.

    A fault is an exception that is not for users, a warning, more than 10 s or 1 GiB, or the end of the process. Mended
    are those that tests/builders/fuzz_seeds holds and that do no harm any more.
    """
    if child is not None:
        run = _by_bytes if only[0] in BY_BYTES else _by_structure
        run(only[0], inputs, seed, child)
        return
    rows = [_feed(name, inputs, seed, save) for name in only or (*BY_STRUCTURE, *BY_BYTES)]
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    click.echo(
        f"{'parser':20}{'engine':12}{'inputs':>8}{'accepted':>10}{'refused':>9}{'found':>7}{'mended':>8}{'left':>6}{'s':>7}"
    )
    for row in rows:
        click.echo(
            f"{row['parser']:20}{row['engine']:12}{row['inputs']:8}{row['accepted']:10}{row['refused']:9}"
            f"{row['found']:7}{row['mended']:8}{row['left']:6}{row['seconds']:7.0f}"
        )
        for what, count in row["faults"].items():
            click.echo(f"    {count} x {what}")
    sys.exit(any(row["left"] for row in rows))


def _feed(name: str, inputs: int, seed: int, save: Path | None) -> dict[str, Any]:
    """One parser in processes of its own, until all inputs were tried; one that dies is a fault."""
    from fuzz_parsers import scratch

    counts: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    start = time.monotonic()
    while (left := inputs - sum(counts.values())) > 0:
        result = scratch() / "result.json"
        args = [
            sys.executable,
            __file__,
            "--only",
            name,
            "--inputs",
            str(left),
            "--seed",
            str(seed),
            "--child",
            str(result),
        ]
        ended = subprocess.run(args, capture_output=True, text=True, check=False)
        found = json.loads(result.read_text()) if result.exists() else {"counts": {}, "faults": {}}
        counts.update(found["counts"])
        faults.update({what: n for what, (n, _) in found["faults"].items()})
        inputs_kept = {what: bytes.fromhex(data) for what, (_, data) in found["faults"].items()}
        current = result.parent / "current"
        if ended.returncode != 0:
            what = f"the process ended with {ended.returncode}: {ended.stderr.strip()[-200:]}"
            counts["fault"] += 1
            faults[what] += 1
            inputs_kept[what] = current.read_bytes() if current.exists() else b""
        for data in inputs_kept.values() if save else ():
            save.mkdir(parents=True, exist_ok=True)  # type: ignore[union-attr]
            (save / f"{slug(name)}-{sha256(data).hexdigest()[:8]}").write_bytes(data)  # type: ignore[operator]
        shutil.rmtree(result.parent)
        seed += 1
    kept = len(list(SEEDS.glob(f"{slug(name)}-*")))
    return {
        "parser": name,
        "engine": "atheris" if name in BY_BYTES else "hypothesis",
        "inputs": sum(counts.values()),
        "accepted": counts["accepted"],
        "refused": counts["refused"],
        "found": kept + len(faults),
        "mended": kept,
        "left": len(faults),
        "faults": dict(faults),
        "seconds": time.monotonic() - start,
    }


def slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


class _Tally:
    """Counts of one child, written every 1000 inputs: a process that dies leaves them, and the input that it died of."""

    def __init__(self, parser: Any, result: Path) -> None:
        self._parser, self._result = parser, result
        self.counts: Counter[str] = Counter()
        self._faults: dict[str, tuple[int, str]] = {}

    def try_one(self, data: bytes) -> None:
        from fuzz_parsers import attempt

        (self._result.parent / "current").write_bytes(data)
        outcome = attempt(self._parser, data)
        self.counts[outcome.status] += 1
        if outcome.status == "fault":
            n, first = self._faults.get(outcome.what, (0, data.hex()))
            self._faults[outcome.what] = n + 1, min(first, data.hex(), key=len)
        if self.counts.total() % 1000 == 0:
            self.write()

    def write(self) -> None:
        self._result.write_text(json.dumps({"counts": self.counts, "faults": self._faults}))


def _by_structure(name: str, inputs: int, seed: int, result: Path) -> None:
    import hypothesis
    from fuzz_parsers import parsers
    from hypothesis import HealthCheck, Phase, settings

    parser = parsers(result.parent)[name]
    tally = _Tally(parser, result)
    quiet = settings(
        max_examples=min(1000, -(-inputs // PER_EXAMPLE)),  # at a time: hypothesis remembers all examples of a test
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    strategy = damaged(parser)

    def try_all(inputs_: list[bytes]) -> None:
        for data in inputs_:
            if tally.counts.total() < inputs:
                tally.try_one(data)

    while tally.counts.total() < inputs:
        hypothesis.seed(seed)(quiet(hypothesis.given(strategy)(try_all)))()
        seed += 1_000_003
    tally.write()


def _by_bytes(name: str, inputs: int, seed: int, result: Path) -> None:
    import atheris

    with atheris.instrument_imports(include=["rgbd_calib", "PIL", "rosbags"]):
        from fuzz_parsers import parsers

        parser = parsers(result.parent)[name]
    tally = _Tally(parser, result)
    corpus = result.parent / "corpus"
    corpus.mkdir()
    for i, data in enumerate(parser.seeds):
        (corpus / str(i)).write_bytes(data)

    def one(data: bytes) -> None:
        tally.try_one(data)
        if tally.counts.total() >= inputs:
            tally.write()

    def mutate(data: bytes, most: int, number: int) -> bytes:
        mutated = atheris.Mutate(data, most)
        return with_checksums(mutated)[:most] if number % 4 else mutated

    longest = 2 * max(map(len, parser.seeds))
    options = [
        f"-runs={inputs}",
        f"-seed={seed + 1}",
        f"-max_len={longest}",
        "-timeout=0",
        "-rss_limit_mb=0",
        "-verbosity=0",
    ]
    atheris.Setup(["fuzz", *options, str(corpus)], one, custom_mutator=mutate if name == "images" else None)
    atheris.Fuzz()


def with_checksums(data: bytes) -> bytes:
    """A PNG's chunks with their checksums made right, so that damage gets past them."""
    if not data.startswith(b"\x89PNG"):
        return data
    out, at = [data[:8]], 8
    while at + 8 <= len(data):
        end = at + 8 + min(int.from_bytes(data[at : at + 4], "big"), len(data))
        out += [data[at:end], zlib.crc32(data[at + 4 : end]).to_bytes(4, "big")]
        at = end + 4
    return b"".join(out)


def damaged(parser: Any) -> Any:
    """Strategy of PER_EXAMPLE damaged versions of a parser's valid file, as bytes.

    Hypothesis draws the values; where they go is left to a generator that it seeds, which takes 0.1 ms instead of 5.
    """
    from hypothesis import strategies as st

    scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    values = scalars | st.lists(scalars, max_size=3) | st.dictionaries(st.text(max_size=4), scalars, max_size=2)
    make = _damage_table if parser.table else _damage_tree
    pool = st.lists(values, min_size=10, max_size=10)

    def all_of(drawn: tuple[list[Any], int]) -> list[bytes]:
        rng = random.Random(drawn[1])
        return [_damage_text(rng, make(rng, parser, [*drawn[0], *HOSTILE])) for _ in range(PER_EXAMPLE)]

    return st.tuples(pool, st.integers(0, 2**64)).map(all_of)


def _damage_tree(rng: random.Random, parser: Any, values: list[Any]) -> bytes:
    import yaml

    tree = copy.deepcopy(parser.tree)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        holder, key = rng.choice(list(_places(tree)) or [(tree, "new")])
        there = key in holder if isinstance(holder, dict) else key < len(holder)
        how = rng.choice(("replace", "replace", "replace", "delete", "rename", "wrap", "deep", "add"))
        if how == "replace":
            holder[key] = copy.deepcopy(rng.choice(values))
        elif how == "delete" and there:
            del holder[key]
        elif how == "rename" and isinstance(holder, dict):
            holder[str(rng.choice(values))] = holder.pop(key, None)
        elif how == "wrap" and there:
            holder[key] = [holder[key]]
        elif how == "deep" and there:
            for _ in range(rng.choice((1, 3, 100))):
                holder[key] = {"a": holder[key]}
        elif how == "add" and isinstance(holder, dict):
            holder[str(rng.choice(values))] = copy.deepcopy(rng.choice(values))
    text = yaml.dump(tree, Dumper=yaml.CSafeDumper, sort_keys=False, allow_unicode=True)
    return (text + (BOMB if rng.random() < 0.02 else "")).encode("utf-8", "replace")


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (holder, key) of a tree, not deeper than 10."""
    waiting = [(tree, 0)]
    while waiting:
        holder, depth = waiting.pop()
        for key, value in holder.items() if isinstance(holder, dict) else enumerate(holder):
            yield holder, key
            if isinstance(value, dict | list) and depth < 10:
                waiting.append((value, depth + 1))


def _damage_table(rng: random.Random, parser: Any, values: list[Any]) -> bytes:
    table = [list(row) for row in parser.table]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        row = rng.choice(table)
        at = rng.randrange(len(row)) if row else 0
        how = rng.choice(("cell", "cell", "cell", "drop", "more", "again", "gone", "column"))
        if how == "cell" and row:
            row[at] = str(rng.choice(values))
        elif how == "drop" and row:
            del row[at]
        elif how == "more":
            row.insert(at, str(rng.choice(values)))
        elif how == "again":
            table.append(list(row))
        elif how == "gone" and len(table) > 1:
            table.remove(row)
        elif how == "column":
            table = [r[:at] + r[at + 1 :] for r in table]
    end, comma = rng.choice(("\n", "\n", "\r\n", "\r")), rng.choice((",", ",", ",", ",", ";"))
    comma = " " if parser.name == "rgb.txt" else comma
    return "".join(comma.join(row) + end for row in table).encode("utf-8", "replace")


def _damage_text(rng: random.Random, data: bytes) -> bytes:
    """Now and then cut, with a few bytes more, or with a line twice."""
    at, how = rng.randrange(len(data) + 1), rng.choice(("", "", "", "", "cut", "insert", "line"))
    if how == "cut":
        return data[:at]
    if how == "insert":
        return data[:at] + rng.randbytes(rng.randint(1, 4)) + data[at:]
    lines = data.splitlines(keepends=True)
    if how == "line" and lines:
        k = rng.randrange(len(lines))
        return b"".join([*lines[: k + 1], *lines[k:]])
    return data


if __name__ == "__main__":
    main()
