"""Names of cameras from the paths of their images: what differs between streams of the same kind."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.layout import Kind, braced, closed, is_plain, unbraced
from rgbd_calib.io.schema_base import check_name

FRAME, CAMERA = "{frame}", "{camera}"
TOKENS = re.compile(r"\{frame\}|\{\{|\}\}|[^\W\d_]+|\d+|[^\w{}]|_")
"""Words, numbers, and what stands between them."""
Naming = tuple[list[str], str | None]
"""Cameras of the streams of one kind, and their pattern."""


def name_cameras(root: Path, by_kind: Mapping[Kind, Sequence[str]]) -> dict[Kind, Naming]:
    """Names of the cameras of each kind's templates, such that those with depth or infrared are among those with colour.

    Raises
    ------
    ConfigError
        The templates do not tell which camera is which; `root` is named in it.
    """
    templates = {kind: _one_suffix(list(of_kind)) for kind, of_kind in by_kind.items()}
    color = [way for way in _namings(templates["color"]) if _are_names(way[0])]
    if len(templates["color"]) == 1:
        color.append(([_alone(templates["color"][0])], templates["color"][0]))
    if not color:
        raise _unclear(root, "color", templates["color"], "")
    first_unclear: ConfigError | None = None
    for names, pattern in color:
        named: dict[Kind, Naming] = {"color": (names, pattern)}
        for kind in ("depth", "ir"):
            ways: list[Naming] = [([], None)]
            if templates[kind]:
                ways = [*_by_known(templates[kind], names), *_namings(templates[kind])]
            if len(templates[kind]) == len(names) == 1:
                ways.append((names, templates[kind][0]))
            fitting = [way for way in ways if set(way[0]) <= set(names) and len(set(way[0])) == len(way[0])]
            if not fitting:
                of = f", and the cameras are {', '.join(names)}"
                first_unclear = first_unclear or _unclear(root, kind, templates[kind], of)
                break
            named[kind] = fitting[0]
        else:
            return named
    assert first_unclear is not None
    raise first_unclear


def _unclear(root: Path, kind: Kind, templates: Sequence[str], of: str) -> ConfigError:
    split = [TOKENS.findall(t) for t in templates]
    same = len({len(tokens) for tokens in split}) == 1
    places = [set(column) for column in zip(*split, strict=True) if len(set(column)) > 1] if same else []
    several = len(places) > 1 and len(templates) > max(map(len, places))
    takes = f". If {root} holds several recordings, give the folder of one of them" if several else ""
    return ConfigError(
        f"{root}: {kind} images {', '.join(templates[:6])} seen{of}; their names do not tell which camera is which{takes}. Say "
        f"it: --{kind} PATTERN, with {CAMERA} and {FRAME} in it"
    )


def _one_suffix(templates: list[str]) -> list[str]:
    """With `.*` in place of suffixes that differ from camera to camera."""
    if len({t.rpartition(".")[2] for t in templates}) < 2:
        return templates
    return [f"{t.rpartition('.')[0]}.*" for t in templates]


def _by_known(templates: Sequence[str], cameras: Sequence[str]) -> list[Naming]:
    """Templates with the name of a known camera in each."""
    names: list[str] = []
    patterns: set[str] = set()
    for template in templates:
        there = [c for c in cameras if re.search(rf"(?<![^\W_]){re.escape(braced(c))}(?![^\W_])", template)]
        if len(there) != 1:
            return []
        names.append(there[0])
        patterns.add(template.replace(braced(there[0]), CAMERA))
    return [(names, patterns.pop())] if len(patterns) == 1 else []


def _are_names(names: Sequence[str]) -> bool:
    return len({name.casefold() for name in names}) == len(names) and all(map(_is_name, names))


def _is_name(text: str) -> bool:
    try:
        return bool(check_name(text))
    except ValueError:
        return False


def _alone(template: str) -> str:
    """The name of an only camera: its folder's, where that is all that its folder is for."""
    folder, *rest = template.split("/")
    kinds = ("color", "colour", "rgb", "depth", "ir")
    return unbraced(folder) if len(rest) == 2 and rest[0] in kinds and _is_name(unbraced(folder)) else "C1"


def _namings(templates: Sequence[str]) -> list[Naming]:
    """Ways to read the cameras' names from templates, best first: names, and the pattern that they leave."""
    if len(templates) == 1:
        template = templates[0]
        ways: list[Naming] = []
        for match in re.finditer(r"(?:^|(?<=[/_.\- ]))[^\W\d_]+\d+(?=[/_.\- ])", template):  # cam0 in cam0_rgb_{frame}
            ways.append(([match.group()], template.replace(match.group(), CAMERA)))
        folder = template.split("/")[0]
        if _alone(template) == unbraced(folder):
            ways.insert(0, ([unbraced(folder)], template.replace(folder, CAMERA, 1)))
        return ways
    ways = _by_tokens(templates)
    first, last = _common(templates), _common([t[::-1] for t in templates])
    for widen in (r"[^/]", r"[^\W_]", r"[^\W\d_]", r""):
        head = re.sub(rf"{widen}*$", "", first) if widen else first
        tail = re.sub(rf"{widen}*$", "", last) if widen else last
        middles = [t[len(head) : len(t) - len(tail)] for t in templates]
        pattern = head + CAMERA + tail[::-1]
        if all(middles) and all(map(is_plain, middles)) and closed(pattern):
            ways.append(([unbraced(m) for m in middles], pattern))
    return ways


def _by_tokens(templates: Sequence[str]) -> list[Naming]:
    """Templates of the same words but one, which may come more than once: C1/C1_rgb_{frame}.png."""
    split = [TOKENS.findall(t) for t in templates]
    if len({len(tokens) for tokens in split}) > 1:
        return []
    places = [i for i, column in enumerate(zip(*split, strict=True)) if len(set(column)) > 1]
    if not places or any(len({tokens[i] for i in places}) > 1 for tokens in split):
        return []
    ways: list[Naming] = []
    with_letters = all(i > 0 and split[0][i - 1].isalpha() and split[0][i].isdigit() for i in places)
    for wide in (True, False) if with_letters else (False,):
        lead = {split[0][i - 1] for i in places} if wide else {""}
        if len(lead) > 1:
            continue
        names = [unbraced(next(iter(lead)) + tokens[places[0]]) for tokens in split]
        pattern = "".join(
            CAMERA if i in places else "" if wide and i + 1 in places else token for i, token in enumerate(split[0])
        )
        ways.append((names, pattern))
    return ways


def _common(texts: Sequence[str]) -> str:
    """The longest common beginning."""
    low, high = min(texts), max(texts)
    n = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), min(len(low), len(high)))
    return low[:n]
