"""What an unknown of the rig says of itself, once: parameters, prior, derivative, size.

A block is a group of parameters of the whole rig or of each camera. The estimate, its covariance, the score test of the
self-checks, and what is told to people all come from it. To add an unknown, write a block in a file of its own and list it in
:mod:`rgbd_calib.rig.blocks`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rgbd_calib.geometry.linear import BoolArray, IntArray
from rgbd_calib.geometry.so3 import FloatArray

if TYPE_CHECKING:
    from rgbd_calib.rig.setup import Setup
    from rgbd_calib.rig.sight import Look


class Kind(Enum):
    """What a row is of."""

    PIXEL = "pixels"
    DEPTH = "depth"
    WALL = "walls"


class Scope(Enum):
    """What a block has one set of parameters for."""

    RIG = "rig"
    CAMERA = "camera"


@dataclass(frozen=True)
class Component:
    """Parameters whose prior has one size that is estimated with the rest: a variance component.

    Their prior is N(0, size^2 R^-1), and size^2 itself has a scaled inverse chi^2 prior of `dof` degrees of freedom about
    `usual`^2: with no data it stays at what is usual.
    """

    name: str
    parameters: IntArray
    """(k,), numbers among the block's."""
    structure: FloatArray
    """R (k, k)."""
    usual: float
    dof: float
    most: float = math.inf
    """No such thing is larger."""


@dataclass(frozen=True)
class BlockPrior:
    """Gaussian knowledge of a block's parameters, and which of them are free."""

    mean: FloatArray
    """(size,)."""
    information: FloatArray
    """(size, size), inverse covariance, without that of the components."""
    free: BoolArray
    """(size,) bool."""
    assumed: BoolArray
    """(size,) bool: the knowledge is an assumption, not a measurement; where the recording adds none, it is said."""
    components: tuple[Component, ...] = ()

    def free_components(self) -> Iterator[Component]:
        """The components of what is free: parameters that are held would count as found to be zero."""
        for c in self.components:
            if (free := self.free[c.parameters]).any():
                yield replace(c, parameters=c.parameters[free], structure=c.structure[np.ix_(free, free)])


@dataclass(frozen=True)
class Told:
    """An estimate of a test, for the sentence about it."""

    estimate: FloatArray
    """(q,)."""
    covariance: FloatArray
    """(q, q)."""
    effect_m: float
    """RMS over the corners concerned of what it moves them by, metres."""
    camera: str
    """Or cameras, or empty for the board."""
    frame: str
    """From which on; empty where it is not of time."""
    distance_m: float
    """Of the boards concerned."""

    @property
    def mm(self) -> str:
        return f"{1e3 * self.effect_m:.1f} mm"


@dataclass(frozen=True)
class Fault:
    """A test of a block: what it is called, and what is said where it fails."""

    check: str
    say: Callable[[Told], str]
    advice: str
    parameters: int | None = None
    """The first so many of the block's are tested; None: all."""
    shared: bool = False
    """Only in frames that several cameras see."""


class Block(ABC):
    """A group of parameters of one meaning."""

    name: ClassVar[str]
    scope: ClassVar[Scope]
    kinds: ClassVar[frozenset[Kind]]
    """Rows that it changes."""
    held: ClassVar[Fault | None] = None
    """What is said where it is held at zero and is not zero."""
    of_all: ClassVar[Fault | None] = None
    """The same where all cameras have the same."""
    over_time: ClassVar[Fault | None] = None
    """What is said where it is another from some frame on."""
    between_recordings: ClassVar[Fault | None] = None
    """What is said where it is another in the views of each camera alone."""
    known: ClassVar[Fault | None] = None
    """What is said where it is not what was known before."""
    least_seen: ClassVar[float] = 1e-4
    """Share of its columns that the rest of the model must leave, for a test of it."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Is there anything of its kind?"""
        return True

    @property
    @abstractmethod
    def parameters(self) -> tuple[str, ...]:
        """Names of one set of parameters, for people."""

    @property
    def n(self) -> int:
        """Parameters of one set."""
        return len(self.parameters)

    @property
    def sets(self) -> int:
        return len(self.setup.cameras) if self.scope is Scope.CAMERA else 1

    @property
    def size(self) -> int:
        return self.sets * self.n

    def start(self) -> FloatArray:
        """Where the estimate begins: (sets, n), or what :meth:`moved` moves."""
        return np.zeros((self.sets, self.n))

    def prior(self) -> BlockPrior:
        """What is known before the recording; nothing, unless the block says more."""
        n = self.size
        return BlockPrior(np.zeros(n), np.zeros((n, n)), np.ones(n, bool), np.zeros(n, bool))

    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        """The value after a step (size,)."""
        return value + step.reshape(self.sets, self.n)

    def vector(self, value: FloatArray) -> FloatArray:
        """(size,), to be compared with the prior's mean."""
        return value.ravel()

    @abstractmethod
    def derivative(self, look: Look) -> FloatArray:
        """Of the predicted rows by one set of parameters, (n, N, r, n_parameters)."""

    def effect(self, distance_m: float, lateral_m: float) -> FloatArray | None:
        """Mean square of what it does, metres, as a quadratic form of its parameters; None: as the rows have it.

        `distance_m` is of the boards, `lateral_m` what a pixel is there.
        """
        return None

    def changes(self, look: Look) -> bool:
        """Do these rows depend on it?"""
        return look.kind in self.kinds

    def columns(self, camera: int) -> IntArray:
        """(n,), numbers among the block's parameters of the set that a camera's rows depend on."""
        return (camera if self.scope is Scope.CAMERA else 0) * self.n + np.arange(self.n)


class PointBlock(Block):
    """A block of the board of which each row depends on the parameters of its own corner alone."""

    @abstractmethod
    def point_columns(self, look: Look) -> IntArray:
        """(n, N, s), numbers among the block's parameters."""

    def columns(self, camera: int) -> IntArray:
        return np.zeros(0, int)
