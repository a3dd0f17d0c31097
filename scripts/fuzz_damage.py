"""Damage for `fuzz.py`: by structure to trees and tables, and checksums made right after damage by bytes."""

from __future__ import annotations

import copy
import json
import random
import zlib
from collections.abc import Iterator
from typing import Any

PER_EXAMPLE = 100
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

    tree = copy.deepcopy(rng.choice(parser.trees))
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
    if parser.name.endswith(".json") or (parser.name == "calibration trees" and rng.random() < 0.5):
        return json.dumps(tree).encode("utf-8", "replace")
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
