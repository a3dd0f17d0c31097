"""The line at which a key of a YAML text stands, for error messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import yaml

_Base: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
Place = tuple[str | int, ...]
"""Keys, and numbers of list items, from the top of a file down."""


def line_of(text: str, keys: Sequence[str | int]) -> int | None:
    """Line, from 1, of the key at this place, or of the deepest part of the place that is there; None where none is."""
    wanted = tuple(keys)
    found, depth = None, 0
    try:
        for place, line in _places(text):
            if depth < len(place) <= len(wanted) and place == wanted[: len(place)]:
                found, depth = line, len(place)
                if depth == len(wanted):
                    break
    except yaml.YAMLError:
        pass
    return found


def _places(text: str) -> Iterator[tuple[Place, int]]:
    """Every key and list item with its line, by the parser's events: nothing recurses or is kept."""
    place: list[str | int | None] = []
    """For each open collection: the key whose value comes next, the item's number, or None where a key comes next."""
    lists: list[bool] = []
    for event in yaml.parse(text, Loader=_Base):
        if isinstance(event, yaml.CollectionEndEvent):
            place.pop()
            lists.pop()
            _after_value(place, lists)
        elif isinstance(event, yaml.NodeEvent):
            line = event.start_mark.line + 1 if event.start_mark else 1
            if place and place[-1] is None:  # a key
                place[-1] = str(event.value) if isinstance(event, yaml.ScalarEvent) else ""
                yield tuple(p for p in place if p is not None), line
                continue
            if place and lists[-1]:
                yield tuple(p for p in place if p is not None), line
            if isinstance(event, yaml.CollectionStartEvent):
                lists.append(isinstance(event, yaml.SequenceStartEvent))
                place.append(0 if lists[-1] else None)
            else:
                _after_value(place, lists)


def _after_value(place: list[str | int | None], lists: list[bool]) -> None:
    """The value of the innermost collection's key or item has ended."""
    if place:
        last = place[-1]
        place[-1] = last + 1 if lists[-1] and isinstance(last, int) else None
