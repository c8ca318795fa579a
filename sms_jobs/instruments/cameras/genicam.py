"""Cameras of any make through the GenTL producer that their maker installs, by the package harvesters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sms_jobs.errors import DeviceFault, LinkLost
from sms_jobs.instruments.genicam_cameras import Delivered, GenicamCamera, Value
from sms_jobs.instruments.genicam_settings import GenicamSettings
from sms_jobs.instruments.optical_drivers import CameraDriver, DriverContext, optional_package


@dataclass(frozen=True)
class GentlSettings(GenicamSettings):
    """A camera that a GenTL producer reaches.

    Attributes
    ----------
    producer
        The producer's file (.cti).
    """

    driver: Literal["genicam"]
    producer: str = ""


class GentlFeatures:
    """The features of a camera that a producer has opened."""

    def __init__(self, camera: str, nodes: Any) -> None:
        self._name = camera
        self._nodes = nodes

    def has(self, name: str) -> bool:
        """Say whether the camera has a feature now."""
        from genicam.genapi import EAccessMode

        if not self._nodes.has_node(name):
            return False
        with _words(self._name):
            mode = self._nodes.get_node(name).get_access_mode()
        return mode in (EAccessMode.RO, EAccessMode.RW, EAccessMode.WO)

    def get(self, name: str) -> Value:
        """Return the value of a feature."""
        with _words(self._name):
            value: Value = self._nodes.get_node(name).value
        return value

    def set(self, name: str, value: Value) -> None:
        """Set a feature."""
        with _words(self._name):
            try:
                self._nodes.get_node(name).value = value
            except (TypeError, AttributeError) as error:
                raise DeviceFault(f"camera {self._name} wants another kind of value for {name}") from error

    def limits(self, name: str) -> tuple[float, float]:
        """Return the least and the greatest value of a number."""
        with _words(self._name):
            node = self._nodes.get_node(name)
            try:
                return float(node.min), float(node.max)
            except AttributeError as error:
                raise DeviceFault(
                    f"camera {self._name} wants no number for {name}: correct the rig file"
                ) from error

    def execute(self, name: str) -> None:
        """Execute a command."""
        with _words(self._name):
            self._nodes.get_node(name).execute()


class GentlStream:
    """Frames of a camera that a producer has opened."""

    def __init__(self, name: str, acquirer: Any) -> None:
        self._name = name
        self._acquirer = acquirer

    def start(self, buffers: int) -> None:
        """Begin an acquisition, with buffers of its own."""
        with _words(self._name):
            self._acquirer.num_buffers = buffers
            self._acquirer.start()

    def stop(self) -> None:
        """End it, and forget what was under way."""
        with _words(self._name):
            self._acquirer.stop()

    def take(self, timeout_s: float, use: Callable[[Delivered], None]) -> bool:
        """Hand over the oldest frame that was not taken; return False when none comes in time.

        What is not complete is dropped by harvesters, and nothing comes then.
        """
        with _words(self._name):
            # harvesters takes 0 for no limit at all.
            buffer = self._acquirer.try_fetch(timeout=max(timeout_s, 1e-3), is_raw=True)
        if buffer is None:
            return False
        try:
            with _words(self._name):
                data = np.frombuffer(buffer.raw_buffer, np.uint8)[_start(buffer) :]
                number, time_s = int(buffer.frame_id), _time_s(buffer)
            use(Delivered(number, time_s, data))
        finally:
            with _words(self._name):
                buffer.parent.queue_buffer(buffer)
        return True

    def close(self) -> None:
        """Let go of the camera."""
        acquirer, self._acquirer = self._acquirer, None
        if acquirer is not None:
            with suppress(Exception):
                acquirer.destroy()


def _start(buffer: Any) -> int:
    """Return where the image begins in its buffer."""
    from genicam.gentl import GenericException

    try:
        return int(buffer.image_offset)
    except GenericException:
        return 0


def _time_s(buffer: Any) -> float | None:
    """Return the camera's time of a frame, where it tells one whose unit is known."""
    from genicam.gentl import GenericException

    with suppress(GenericException):
        return float(buffer.timestamp_ns) / 1e9
    return None


@contextmanager
def _words(camera: str) -> Iterator[None]:
    """Turn what the camera refuses and what the producer reports into errors of ours."""
    from genicam import genapi, gentl

    try:
        yield
    except genapi.GenericException as error:
        raise DeviceFault(f"camera {camera} refuses: {_sentence(error)}") from error
    except gentl.GenericException as error:
        raise LinkLost(
            f"camera {camera} does not answer: {_sentence(error)}; check its cable and power"
        ) from error


def _sentence(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def connect(camera: GentlSettings, context: DriverContext) -> GenicamCamera:
    """Open a camera.

    Raises
    ------
    ConfigurationError
        When harvesters is not installed.
    LinkLost
        When there is no such producer or camera, or it does not answer.
    DeviceFault
        When it refuses what it is to be set to.
    """
    harvesters: Any = optional_package(_harvesters, DRIVER.name, "genicam")

    def make() -> Any:
        if not Path(camera.producer).is_file():
            raise LinkLost(
                f"camera {camera.name} is reached by the producer '{camera.producer}', which is no file: "
                "install the camera's program and name its .cti file"
            )
        harvester = harvesters.Harvester()
        context.ending.callback(harvester.reset)
        with _words(camera.name):
            harvester.add_file(camera.producer)
            harvester.update()
        return harvester

    harvester = context.shared(("producer", camera.producer), make)
    known = [info.property_dict for info in harvester.device_info_list]
    chosen = [
        i
        for i, properties in enumerate(known)
        if camera.device in (properties["id_"], properties["serial_number"])
    ]
    if len(chosen) != 1:
        listed = ", ".join(
            f"{properties['id_']} (serial number {properties['serial_number']})" for properties in known
        )
        raise LinkLost(
            f"camera {camera.name} is not found as '{camera.device}': the producer lists {listed or 'none'}; "
            "check its cable and power"
        )
    with _words(camera.name):
        acquirer = harvester.create(chosen[0])
    stream = GentlStream(camera.name, acquirer)
    context.ending.callback(stream.close)
    features = GentlFeatures(camera.name, acquirer.remote_device.node_map)
    return GenicamCamera(camera, features, stream, context.clock)


def _harvesters() -> Any:
    import harvesters.core

    return harvesters.core


DRIVER = CameraDriver("genicam", GentlSettings, connect)
