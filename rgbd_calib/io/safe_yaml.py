"""YAML from strangers: plain values only, bounded in size, depth and number of values, no key twice.

A first pass over the parser's events, which neither recurses nor keeps anything, refuses what would exhaust the second:
libyaml's composer recurses without a limit, and a few hundred bytes of nested aliases stand for 10^9 values.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import yaml

MAX_BYTES = 64 << 20
"""A rig of 8 cameras and 10,000 frames is 10 MB, one of 99 simulated cameras 28 MB."""
MAX_VALUES = 2_500_000
"""Values after aliases are written out; 99 simulated cameras are 2,000,000, 10,000 board poses 170,000. 1 GB and 25 s."""
MAX_DEPTH = 64
"""Lists and mappings within each other; a rig file has 7."""
MAX_DIGITS = 64
"""Characters of a number: reading one takes the square of its length."""

_Base: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class UnsafeYaml(Exception):
    """What is wrong, where, and what to do, without the file's name."""


def load(text: str, as_text: bool = False) -> Any:
    """The only document of a YAML text; keys are text as written, and so are all values where `as_text`.

    Raises
    ------
    UnsafeYaml
        Not YAML, or YAML that no file of this program needs: tags, a key twice, too large, too deep.
    """
    try:
        _check(text)
        return yaml.load(text, Loader=_Words if as_text else _Loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        words = " ".join(str(error).split())
        raise UnsafeYaml(f"not valid YAML: {words if len(words) < 300 else words[:297] + '...'}") from error


class _Loader(_Base):  # type: ignore[misc, valid-type]
    """Plain values: keys and dates are text, numbers are short."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}

    def construct_yaml_int(self, node: yaml.ScalarNode) -> Any:
        return super().construct_yaml_int(_short_number(node))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> Any:
        return super().construct_yaml_float(_short_number(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)
_Loader.add_constructor("tag:yaml.org,2002:timestamp", _Loader.construct_yaml_str)


class _Words(_Loader):
    """Every value is text: `on` is no boolean."""


for _tag in ("int", "float", "bool", "null"):
    _Words.add_constructor(f"tag:yaml.org,2002:{_tag}", _Loader.construct_yaml_str)


def _short_number(node: yaml.ScalarNode) -> yaml.ScalarNode:
    if len(node.value) > MAX_DIGITS:
        raise yaml.constructor.ConstructorError(None, None, f"a number of {len(node.value)} digits", node.start_mark)
    return node


@dataclass
class _Level:
    """A list or a mapping that is open."""

    mapping: bool
    anchor: str | None
    before: int
    """Values before it."""
    keys: set[str] = field(default_factory=set)
    key_is_next: bool = True


def _check(text: str) -> None:
    """Raise UnsafeYaml for what must not be composed."""
    levels: list[_Level] = []
    sizes: dict[str, int] = {}
    values = 0
    for event in yaml.parse(text, Loader=_Base):
        if isinstance(event, yaml.CollectionEndEvent):
            ended = levels.pop()
            if ended.anchor:
                sizes[ended.anchor] = values - ended.before
            continue
        if not isinstance(event, yaml.NodeEvent):
            continue
        line = event.start_mark.line + 1 if event.start_mark else 0
        tag = getattr(event, "tag", None) or "!"
        if tag != "!":
            raise UnsafeYaml(f"line {line}: tag {str(tag)[:60]!r} seen; plain YAML is needed. Take the tag out")
        if levels and levels[-1].mapping:
            _check_key(event, levels[-1], line)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise UnsafeYaml(
                    f"line {line}: '*{str(event.anchor)[:60]}' stands for what is not complete there. Write it out"
                )
            values += sizes[event.anchor]
        else:
            if isinstance(event, yaml.CollectionStartEvent):
                levels.append(_Level(isinstance(event, yaml.MappingStartEvent), event.anchor, values))
            elif event.anchor:
                sizes[event.anchor] = 1
            values += 1
        if values > MAX_VALUES or len(levels) > MAX_DEPTH:
            raise UnsafeYaml(
                f"line {line}: more than {MAX_VALUES} values, or {MAX_DEPTH} levels, seen (aliases written out); no such "
                "file has that many. Is it the right file?"
            )


def _check_key(event: yaml.NodeEvent, level: _Level, line: int) -> None:
    """Raise UnsafeYaml where a key is no word, or is there already; keys and values take turns."""
    if level.key_is_next:
        if not isinstance(event, yaml.ScalarEvent):
            raise UnsafeYaml(f"line {line}: a key that is no word seen. Write `key: value`")
        if event.value in level.keys:
            raise UnsafeYaml(f"line {line}: key {event.value[:60]!r} stands there twice; once is needed. Take one out")
        level.keys.add(event.value)
    level.key_is_next = not level.key_is_next
