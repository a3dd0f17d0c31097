"""Every setting of a calibration with its default, in one place; YAML over the defaults, the command line over both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from rgbd_calib.cameras.depth_bias import DepthBiasParams
from rgbd_calib.cameras.intrinsics import IntrinsicsParams
from rgbd_calib.errors import ConfigError
from rgbd_calib.io.files import load_yaml
from rgbd_calib.io.schema_base import find_line
from rgbd_calib.io.tables import short
from rgbd_calib.rig.biobjective import RefinementParams
from rgbd_calib.rig.blocks import ESTIMATED
from rgbd_calib.rig.initialization import InitializationParams
from rgbd_calib.rig.setup import BundleParams
from rgbd_calib.trust.self_check import SelfCheckParams
from rgbd_calib.trust.verdict import VerdictLimits
from rgbd_calib.views.association import AssociationParams
from rgbd_calib.views.board_pose import BoardPoseParams
from rgbd_calib.views.detect import DetectParams
from rgbd_calib.views.plane_filter import PlaneFilterParams

_LARGEST = 1e12
Method = Literal["init", "ba", "icp", "baicp+", "biobjective", "bundle"]


@dataclass(frozen=True)
class Config:
    """Settings of the whole calibration, a section for each stage."""

    method: Method = "bundle"
    start: Literal["given", "bundle"] = "given"
    """Where another method than the bundle has lenses, depth, board and first poses from: as they are known before, or the bundle."""
    reference: str | None = None
    """Camera whose frame is the world; None: the first of dataset.yaml."""
    seed: int = 0
    max_views: int | None = None
    """Frames of the board from which the rig is calibrated at most (the most informative); None: all."""
    detect: DetectParams = field(default_factory=DetectParams)
    intrinsics: IntrinsicsParams = field(default_factory=IntrinsicsParams)
    depth_bias: DepthBiasParams = field(default_factory=DepthBiasParams)
    plane_filter: PlaneFilterParams = field(default_factory=PlaneFilterParams)
    board_pose: BoardPoseParams = field(default_factory=BoardPoseParams)
    association: AssociationParams = field(default_factory=AssociationParams)
    initialization: InitializationParams = field(default_factory=InitializationParams)
    refinement: RefinementParams = field(default_factory=RefinementParams)
    bundle: BundleParams = field(default_factory=BundleParams)
    self_check: SelfCheckParams = field(default_factory=SelfCheckParams)
    verdict: VerdictLimits = field(default_factory=VerdictLimits)


def load_config(path: Path | None, **over: Any) -> Config:
    """The configuration in a YAML file (None: the defaults), with the given values over it; None leaves a value be.

    Keys of `over` name nested settings with two underscores, as ``refinement__sigma_2d_px=0.3``.

    Raises
    ------
    ConfigError
        An unknown key (with a suggestion), or a value that does not fit.
    """
    data = {} if path is None else load_yaml(path)
    where = str(path) if path else "configuration"
    _check_keys(Config, data, path, ())
    if "method" in data.get("refinement", {}):
        raise ConfigError(f"{where}: refinement.method: set by `method`, which names all estimators. Move it there")
    return _validated(data, where, over)


def with_settings(config: Config, over: Mapping[str, Any]) -> Config:
    """The configuration with the given values over it, named as for :func:`load_config`.

    Raises
    ------
    ConfigError
        An unknown key (with a suggestion), or a value that does not fit.
    """
    return _validated(as_plain(config), "configuration", over)


def _validated(data: dict[str, Any], where: str, over: Mapping[str, Any]) -> Config:
    for key, value in over.items():
        if value is not None:
            *sections, last = key.split("__")
            into = data
            for section in sections:
                into = into.setdefault(section, {})
            into[last] = value
    _check_keys(Config, data, None, ())
    try:
        config = _adapter().validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{where}: {key}: {short(first['input'])} seen; {first['msg']}") from None
    _check_numbers(asdict(config), where, "")
    blocks = [block.name for block in ESTIMATED]
    for name in config.bundle.hold:
        if name not in blocks:
            raise ConfigError(f"{where}: bundle.hold: {short(name)} seen; one of {', '.join(blocks)} needed")
    return config


@cache
def _adapter() -> TypeAdapter[Config]:
    return TypeAdapter(Config)


def as_plain(config: Config) -> dict[str, Any]:
    """The configuration as nested plain values, to be written beside the result."""
    plain = asdict(config)
    del plain["refinement"]["method"]  # follows `method`
    return plain


def _check_keys(section: type, data: Any, path: Path | None, place: tuple[str, ...]) -> None:
    if not isinstance(data, dict):
        raise ConfigError(f"{_at(path, place)}: {'.'.join(place)}: {short(data)} seen, a section of keys needed")
    known = {f.name: f for f in fields(section)}
    for key, value in data.items():
        here = (*place, str(key))
        if key not in known:
            near = get_close_matches(str(key), known, 1)
            hint = f"Did you mean '{'.'.join((*place, near[0]))}'?" if near else f"Known: {', '.join(known)}"
            raise ConfigError(f"{_at(path, here)}: {'.'.join((*place, _shown(key)))}: no such setting. {hint}")
        factory = known[key].default_factory
        if is_dataclass(factory):
            _check_keys(factory, value, path, here)


def _at(path: Path | None, place: tuple[str, ...]) -> str:
    """The file, and the line of a key in it."""
    line = None if path is None else find_line(path, place)
    return f"{path or 'configuration'}" + (f": line {line}" if line else "")


def _check_numbers(section: dict[str, Any], where: str, prefix: str) -> None:
    """Raise ConfigError for a number that no setting can have: all are counts, sizes and shares."""
    for key, value in section.items():
        if isinstance(value, dict):
            _check_numbers(value, where, f"{prefix}{key}.")
        elif isinstance(value, int | float) and not 0 <= value <= _LARGEST:
            raise ConfigError(
                f"{where}: {prefix}{key}: {value} seen, a number from 0 to {_LARGEST:g} needed. Correct it"
            )


def _shown(key: str) -> str:
    return key if key.isprintable() and len(key) < 60 else short(key)
