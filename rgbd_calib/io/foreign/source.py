"""What every reader of foreign recordings offers: cameras, times or names of pictures, and the pictures one by one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.layout import Kind as Kind
from rgbd_calib.types import Board

Stamps = Mapping[Kind, Sequence[int]]
"""Times of a camera's pictures in the order in which the source delivers them, us."""
Stems = Mapping[Kind, Sequence[str]]
"""Names of a camera's pictures, in the same order: equal names are one instant."""
Wanted = Callable[[str, Kind, int], bool]
"""Whether picture number `index` of a kind of a camera is wanted."""


@dataclass(frozen=True)
class Encoded:
    """An image as the bytes of a file that recordings have as they are: JPEG or PNG."""

    data: bytes
    suffix: str
    """As `.jpg`."""


@dataclass(frozen=True)
class SourceImage:
    """Picture number `index` of one stream."""

    camera: str
    kind: Kind
    index: int
    pixels: np.ndarray | Encoded
    """Colour (h, w, 3) uint8, B G R; depth (h, w), uint16, 0 = none, or float32, metres; infrared (h, w), uint8 or uint16."""


@dataclass(frozen=True, eq=False)
class SourceCamera:
    """What a source says of a camera."""

    intrinsics: Intrinsics | None = None
    serial: str | None = None
    depth_scale: float | None = None
    """Metres for each unit of its 16-bit depth; None: it does not say."""
    registered: bool | None = None
    """Depth lies on its colour image; None: it does not say."""
    depth_intrinsics: Intrinsics | None = None
    """Of depth that is not registered, and of infrared images."""
    T_color_depth: FloatArray | None = None
    """(4, 4), p_color = T_color_depth @ p_depth, metres."""
    float_unit_m: float | None = None
    """Metres for each unit of its floating-point depth; None: its values tell."""
    invalid: tuple[float, ...] = ()
    """Values of depth besides 0 and 65535 that mean "no measurement"."""


class Source(ABC):
    """A foreign recording of one or more cameras."""

    name: str
    """Its path, for messages."""
    cameras: Mapping[str, SourceCamera]
    remarks: tuple[str, ...] = ()
    """What the user should know: what was assumed, and what of it is not used."""
    clock: str | None = None
    """Sources of the same clock have one time; None: a clock of its own."""
    board: Board | None = None
    """The board that it says was filmed."""
    by_time: bool = False
    """Its names are times, and few of them coincide: unless another match is asked for, they join as times."""

    def stamps(self) -> Mapping[str, Stamps]:
        """Times of all pictures by camera; empty sequences where there are none. Of sources without times: nothing."""
        return {}

    def stems(self) -> Mapping[str, Stems] | None:
        """Names of all pictures by camera, where equal names are one instant; None where times tell it."""
        return None

    @abstractmethod
    def pictures(self, wanted: Wanted) -> Iterator[SourceImage]:
        """The wanted pictures, each stream in the order of its stamps; one at a time is in memory."""
