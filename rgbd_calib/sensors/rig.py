"""All cameras of a rig as one source of frame sets, with a watch over each of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from typing import Any

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.dataset import CameraInfo
from rgbd_calib.sensors.driver import Device, DeviceSettings, Driver
from rgbd_calib.sensors.frame_sets import MAX_SPREAD_S, tightest_frame_set
from rgbd_calib.sensors.frames import PERIOD_S, FrameSet, Kind
from rgbd_calib.sensors.identity import Identity
from rgbd_calib.sensors.lasting_threads import run_lasting
from rgbd_calib.sensors.reader import KEEP_PAIRS, DeviceReader, ReaderCounts

Listener = Callable[[str, str], None]
"""Called with (camera or '', what happened)."""

_FIRST_FRAMES_S = 5.0
_MIN_RATE = 0.8  # of 30 fps; below, a bus is shared or the computer is too slow
_WATCH_S = 0.25
_LOOK_S = 1.0


@dataclass
class _Seat:
    """One camera's place in the rig: who belongs there, and who reads it now."""

    identity: Identity
    device: Device
    settings: DeviceSettings
    reader: DeviceReader
    silent: tuple[Kind, ...] = ()
    gone: bool = False
    jumps: int = 0
    """Of its clock, as told so far."""
    finished: tuple[ReaderCounts, ...] = ()
    """Of readers before the camera was plugged in again."""

    @property
    def live(self) -> bool:
        return not self.gone and not self.silent


class SensorRig:
    """Opened, configured and streaming cameras; use as a context manager.

    Parameters
    ----------
    cameras
        {camera id: device to open}.
    listener
        Told in words of everything that goes wrong or right again, from a thread of the rig's own.
    sync_leader
        The camera that gives the pulse of a synchronisation cable; the others follow. None: all run freely.
    settle_s
        How long exposure and white balance may settle before they are locked.
    """

    def __init__(
        self,
        runtime: Driver,
        cameras: Mapping[str, Identity],
        listener: Listener,
        *,
        settle_s: float = 2.0,
        lock_exposure: bool = True,
        keep_depth: int = 1,
        keep_pairs: int = KEEP_PAIRS,
        allow_unregistered: bool = False,
        color_only: bool = False,
        sync_leader: str | None = None,
    ) -> None:
        self._runtime = runtime
        self._listener = listener
        self._settle_s = settle_s
        self._lock_exposure = lock_exposure
        self._keep = keep_depth, keep_pairs
        self._allow_unregistered = allow_unregistered
        self._color_only = color_only
        self._sync_leader = sync_leader
        self._fresh = threading.Condition()
        self._seats: dict[str, _Seat] = {}
        self._stop = threading.Event()
        self._watch: Future[None] | None = None
        self._camera_settings: dict[str, dict[str, Any]] = {}
        self._wanted = dict(cameras)

    def __enter__(self) -> SensorRig:
        try:
            # one after the other: a shared bus shows at the second; the leader last: its pulse must find the others waiting
            for camera in sorted(self._wanted, key=lambda c: c == self._sync_leader):
                self._seats[camera] = self._seat(camera, self._wanted[camera])
            self._seats = {camera: self._seats[camera] for camera in self._wanted}
            self._settle()
        except BaseException:
            self.close()
            raise
        self._watch = run_lasting(self._watch_over)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self._seats)

    @property
    def live_cameras(self) -> tuple[str, ...]:
        """Cameras that deliver both streams now."""
        return tuple(camera for camera, seat in self._seats.items() if seat.live)

    def reader(self, camera: str) -> DeviceReader:
        return self._seats[camera].reader

    def settings(self) -> dict[str, tuple[DeviceSettings, dict[str, Any]]]:
        """What each camera was set to: the device, and exposure and white balance."""
        return {c: (seat.settings, self._camera_settings.get(c, {})) for c, seat in self._seats.items()}

    def describe(self) -> dict[str, CameraInfo]:
        """Sizes, unit of depth and geometry as the devices state them."""
        return {camera: seat.device.describe() for camera, seat in self._seats.items()}

    def counts(self) -> dict[str, ReaderCounts]:
        """What each camera delivered, over all times it was plugged in."""
        return {c: _sum_counts((*seat.finished, seat.reader.counts())) for c, seat in self._seats.items()}

    def set_emitter(self, camera: str, on: bool) -> None:
        self._seats[camera].device.set_emitter(on)

    def next_frame_set(self, after_s: float, timeout_s: float = 1.0, only: str | None = None) -> FrameSet | None:
        """The tightest frame set after `after_s` (host's monotonic clock), of the cameras that are live then.

        A set that spans more than `MAX_SPREAD_S` is refused and a later one waited for. None where no camera
        delivers in time.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._fresh:
            while True:
                live = [c for c in self.live_cameras if only in (None, c)]
                found = tightest_frame_set({c: self._seats[c].reader.pairs() for c in live}, after_s)
                if found is not None and found.spread_s <= MAX_SPREAD_S:
                    asked = self.cameras if only is None else (only,)
                    return replace(found, absent=tuple(c for c in asked if c not in found.frames))
                if found is not None:
                    after_s += PERIOD_S
                    continue
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    return None
                self._fresh.wait(min(left_s, 0.1))

    def close(self) -> None:
        """Stop readers, then streams, then devices; where a reader hangs, leave everything as it is."""
        self._stop.set()
        if self._watch is not None:
            wait([self._watch], 3.0)
        if not all([seat.reader.stop() for seat in self._seats.values()]):
            self._runtime.abandon()
        self._runtime.close()

    def _seat(self, camera: str, identity: Identity) -> _Seat:
        device = self._runtime.open(identity.uri)
        settings = self._set_up(camera, device)
        reader = DeviceReader(camera, device, self._fresh, *self._keep)
        device.start()
        reader.start()
        return _Seat(identity, device, settings, reader)

    def _set_up(self, camera: str, device: Device) -> DeviceSettings:
        settings = device.configure(self._allow_unregistered, self._color_only)
        if "depth" not in device.sizes and not self._color_only:
            self._listener(camera, "has no depth sensor; its colour alone is recorded")
        followers = [c for c in self._wanted if c != self._sync_leader]
        place = 0 if camera == self._sync_leader else 1 + followers.index(camera)
        if self._sync_leader is not None and not device.set_sync(place):
            self._listener(camera, "has no hardware synchronisation; it runs freely")
        return settings

    def _settle(self) -> None:
        """Wait for the first frames of all, let the exposure settle, lock it, and check the frame rates."""
        deadline_s = time.monotonic() + _FIRST_FRAMES_S
        while time.monotonic() < deadline_s and not all(s.reader.counts().pairs for s in self._seats.values()):
            time.sleep(0.02)
        for camera, seat in self._seats.items():
            counts = seat.reader.counts().frames
            silent = [kind for kind, n in counts.items() if n == 0]
            if silent or seat.reader.failure:
                raise CalibrationError(
                    f"{camera} ({seat.device.label}): no {' and no '.join(silent) or 'further'} frame in "
                    f"{_FIRST_FRAMES_S:.0f} s{_because(seat.reader.failure)}; 30 a second needed. Two cameras on one USB "
                    "controller do that (`lsusb -t`): move one, and replug this camera"
                )
        before, start_s = self.counts(), time.monotonic()
        time.sleep(self._settle_s)
        for camera, seat in self._seats.items():
            self._finish_setup(camera, seat)
        elapsed_s = time.monotonic() - start_s
        if elapsed_s >= 1.0:
            after = self.counts()
            for camera in self._seats:
                for kind in after[camera].frames:
                    rate = (after[camera].frames[kind] - before[camera].frames[kind]) / elapsed_s
                    if rate < _MIN_RATE / PERIOD_S:
                        self._listener(
                            camera,
                            f"{kind} comes at {rate:.0f} fps instead of {1 / PERIOD_S:.0f}: a shared USB controller?",
                        )

    def _finish_setup(self, camera: str, seat: _Seat) -> None:
        if self._lock_exposure and not seat.device.lock_exposure():
            self._listener(camera, "exposure and white balance could not be locked; they stay automatic")
        self._camera_settings[camera] = seat.device.camera_settings()

    def _watch_over(self) -> None:
        looked_s = 0.0
        while not self._stop.wait(_WATCH_S):
            for camera, seat in self._seats.items():
                self._notice_silence(camera, seat)
            if time.monotonic() - looked_s > _LOOK_S and not all(seat.live for seat in self._seats.values()):
                looked_s = time.monotonic()
                self._look_for_lost(set(self._runtime.uris()))

    def _notice_silence(self, camera: str, seat: _Seat) -> None:
        if seat.gone:
            return
        if seat.reader.jumps > seat.jumps:
            self._listener(camera, "its clock jumped; frames are matched by time anew")
        seat.jumps = seat.reader.jumps
        silent = seat.reader.silent_kinds()
        if silent != seat.silent:
            stopped = [k for k in silent if k not in seat.silent]
            resumed = [k for k in seat.silent if k not in silent]
            seat.silent = silent
            if stopped:
                self._listener(camera, f"{' and '.join(stopped)} stalled{_because(seat.reader.failure)}")
            if resumed:
                self._listener(camera, f"{' and '.join(resumed)} delivers again")

    def _look_for_lost(self, uris: set[str]) -> None:
        """Say which silent cameras are unplugged, and take back those that were plugged in again."""
        for camera, seat in self._seats.items():
            if not seat.live and not seat.gone and seat.device.uri not in uris:
                seat.gone = True
                self._listener(camera, "unplugged; the other cameras go on. Plug it in again to have it back")
        taken = {seat.device.uri for seat in self._seats.values() if not seat.gone}
        for camera, seat in self._seats.items():
            if seat.gone and not self._stop.is_set():
                for uri in sorted(uris - taken):
                    if self._take_back(camera, seat, uri):
                        taken.add(uri)
                        break

    def _take_back(self, camera: str, seat: _Seat, uri: str) -> bool:
        """Open the device at `uri` for this camera if it is the same one; the old handle is left alone."""
        try:
            device = self._runtime.open(uri)
            if Identity(uri, device.serial, device.usb_path).key != seat.identity.key:
                device.close()
                return False
            settings = self._set_up(camera, device)
            reader = DeviceReader(camera, device, self._fresh, *self._keep)
            device.start()
            reader.start()
        except CalibrationError as error:
            self._listener(camera, f"plugged in again, but not usable: {error}")
            return False
        if not seat.reader.stop():
            self._runtime.abandon()
        seat.finished = (*seat.finished, seat.reader.counts())
        self._listener(camera, "plugged in again")
        self._stop.wait(min(1.0, self._settle_s))
        seat.device, seat.settings, seat.reader = device, settings, reader
        self._finish_setup(camera, seat)
        seat.silent, seat.gone = (), False
        return True


def _because(failure: str | None) -> str:
    return f" ({failure})" if failure else ""


def _sum_counts(counts: tuple[ReaderCounts, ...]) -> ReaderCounts:
    def total(name: str) -> dict[Kind, int]:
        return {kind: sum(getattr(c, name)[kind] for c in counts) for kind in counts[-1].frames}

    return ReaderCounts(total("frames"), total("lost"), total("unpaired"), sum(c.pairs for c in counts))
