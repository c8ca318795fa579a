"""GigE Vision and USB3 Vision cameras through the free library Aravis, without their makers' programs."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from sms_jobs.errors import ConfigurationError, DeviceFault, LinkLost
from sms_jobs.instruments.genicam_cameras import Delivered, GenicamCamera, Value
from sms_jobs.instruments.genicam_settings import GenicamSettings
from sms_jobs.instruments.optical_drivers import CameraDriver, DriverContext

_LIBRARIES = ("libaravis-0.8.so.0", "libaravis-0.8.0.dylib")
_NO_PACKET_SOCKETS = 1
_STATUS = {
    1: "it was cleared",
    2: "packets came too late",
    3: "packets are missing",
    4: "packets came out of order",
    5: "it is larger than its buffer",
    7: "the acquisition was ended",
    8: "its kind of payload is not known",
}
"""Words for `ArvBufferStatus`."""


@dataclass(frozen=True)
class AravisSettings(GenicamSettings):
    """A camera that Aravis reaches; `device` may also be its network address."""

    driver: Literal["aravis"]


class _Error(ctypes.Structure):
    """`GError`."""

    _fields_ = [("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p)]


_ERROR = POINTER(POINTER(_Error))
# name: result, arguments without the last, the error, which those in _TELLING have
_TELLING: dict[str, tuple[Any, list[Any]]] = {
    "arv_camera_new": (c_void_p, [c_char_p]),
    "arv_camera_create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "arv_camera_get_payload": (ctypes.c_uint, [c_void_p]),
    "arv_camera_start_acquisition": (None, [c_void_p]),
    "arv_camera_stop_acquisition": (None, [c_void_p]),
    "arv_device_is_feature_available": (c_int, [c_void_p, c_char_p]),
    "arv_device_execute_command": (None, [c_void_p, c_char_p]),
    "arv_device_set_features_from_string": (c_int, [c_void_p, c_char_p]),
    "arv_device_get_string_feature_value": (c_char_p, [c_void_p, c_char_p]),
    "arv_device_get_integer_feature_value": (c_int64, [c_void_p, c_char_p]),
    "arv_device_get_float_feature_value": (c_double, [c_void_p, c_char_p]),
    "arv_device_get_boolean_feature_value": (c_int, [c_void_p, c_char_p]),
    "arv_device_set_string_feature_value": (None, [c_void_p, c_char_p, c_char_p]),
    "arv_device_set_integer_feature_value": (None, [c_void_p, c_char_p, c_int64]),
    "arv_device_set_float_feature_value": (None, [c_void_p, c_char_p, c_double]),
    "arv_device_set_boolean_feature_value": (None, [c_void_p, c_char_p, c_int]),
    "arv_device_get_integer_feature_bounds": (
        None,
        [c_void_p, c_char_p, POINTER(c_int64), POINTER(c_int64)],
    ),
    "arv_device_get_float_feature_bounds": (
        None,
        [c_void_p, c_char_p, POINTER(c_double), POINTER(c_double)],
    ),
}
_SILENT: dict[str, tuple[Any, list[Any]]] = {
    "arv_camera_get_device": (c_void_p, [c_void_p]),
    "arv_device_get_feature": (c_void_p, [c_void_p, c_char_p]),
    "arv_buffer_new_allocate": (c_void_p, [c_size_t]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_buffer_get_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_camera_gv_set_stream_options": (None, [c_void_p, c_int]),
    "arv_camera_is_gv_device": (c_int, [c_void_p]),
    "g_error_free": (None, [c_void_p]),
    "g_quark_to_string": (c_char_p, [ctypes.c_uint32]),
    "g_object_unref": (None, [c_void_p]),
    "g_type_check_instance_is_a": (c_int, [c_void_p, c_size_t]),
    "arv_gc_integer_get_type": (c_size_t, []),
    "arv_gc_float_get_type": (c_size_t, []),
    "arv_gc_boolean_get_type": (c_size_t, []),
    "arv_gc_enumeration_get_type": (c_size_t, []),
}


@cache
def library() -> Any:
    """Return Aravis with the types of its functions; raise `ConfigurationError` where it is not installed."""
    for name in _LIBRARIES:
        try:
            found = ctypes.CDLL(name)
            break
        except OSError:
            continue
    else:
        raise ConfigurationError(
            "the driver 'aravis' needs the library Aravis 0.8, which is not installed: `apt-get install "
            "aravis-tools-cli` on Debian and Ubuntu, `brew install aravis` on macOS"
        )
    for name, (result, arguments) in {**_TELLING, **_SILENT}.items():
        function = getattr(found, name)
        function.restype = result
        function.argtypes = [*arguments, _ERROR] if name in _TELLING else arguments
    return found


def _call(camera: str, name: str, *arguments: Any) -> Any:
    """Call a function that tells errors; raise `DeviceFault` for what a camera refuses, else `LinkLost`."""
    aravis, error = library(), POINTER(_Error)()
    result = getattr(aravis, name)(*arguments, byref(error))
    if error:
        words = (error.contents.message or b"").decode("utf-8", "replace")
        domain = (aravis.g_quark_to_string(error.contents.domain) or b"").decode("ascii", "replace")
        aravis.g_error_free(error)
        if domain.startswith("arv-gc"):
            raise DeviceFault(f"camera {camera} refuses: {words or name}")
        raise LinkLost(f"camera {camera} does not answer: {words or name}; check its cable and power")
    return result


class AravisFeatures:
    """The features of a camera that Aravis has opened."""

    def __init__(self, camera: str, device: int) -> None:
        self._name = camera
        self._device = device

    def has(self, name: str) -> bool:
        """Say whether the camera has a feature now."""
        return bool(_call(self._name, "arv_device_is_feature_available", self._device, name.encode()))

    def get(self, name: str) -> Value:
        """Return the value of a feature."""
        value = _call(
            self._name, f"arv_device_get_{self._kind(name)}_feature_value", self._device, name.encode()
        )
        return (value or b"").decode("utf-8", "replace") if self._kind(name) == "string" else value

    def set(self, name: str, value: Value) -> None:
        """Set a feature."""
        kind = self._kind(name)
        sent: Any = str(value).encode()
        if kind != "string":
            fits = not isinstance(value, str) and (kind == "float" or int(value) == value)
            if not fits:
                what = "a number" if kind == "float" else "a whole number or a truth value"
                raise DeviceFault(f"camera {self._name} wants {what} for {name}")
            sent = float(value) if kind == "float" else int(value)
        _call(self._name, f"arv_device_set_{kind}_feature_value", self._device, name.encode(), sent)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the least and the greatest value of a number."""
        kind = self._kind(name)
        if kind not in ("integer", "float"):
            raise DeviceFault(f"camera {self._name} wants no number for {name}: correct the rig file")
        low, high = (c_int64(), c_int64()) if kind == "integer" else (c_double(), c_double())
        _call(
            self._name,
            f"arv_device_get_{kind}_feature_bounds",
            self._device,
            name.encode(),
            byref(low),
            byref(high),
        )
        return float(low.value), float(high.value)

    def execute(self, name: str) -> None:
        """Execute a command."""
        _call(self._name, "arv_device_execute_command", self._device, name.encode())

    def _kind(self, name: str) -> str:
        aravis = library()
        node = aravis.arv_device_get_feature(self._device, name.encode())
        if not node:
            raise DeviceFault(f"camera {self._name} has no feature {name}")
        for kind in ("enumeration", "boolean", "float", "integer"):
            if aravis.g_type_check_instance_is_a(node, getattr(aravis, f"arv_gc_{kind}_get_type")()):
                return "string" if kind == "enumeration" else kind
        return "string"


class AravisStream:
    """Frames of a camera that Aravis has opened."""

    def __init__(self, name: str, camera: int) -> None:
        self._name = name
        self._camera = camera
        self._stream: int | None = None

    def start(self, buffers: int) -> None:
        """Begin an acquisition, with a receiver of its own."""
        self._release()
        aravis = library()
        self._stream = _call(self._name, "arv_camera_create_stream", self._camera, None, None)
        payload = _call(self._name, "arv_camera_get_payload", self._camera)
        for _ in range(buffers):
            aravis.arv_stream_push_buffer(self._stream, aravis.arv_buffer_new_allocate(payload))
        _call(self._name, "arv_camera_start_acquisition", self._camera)

    def stop(self) -> None:
        """End it, and forget what was under way."""
        try:
            _call(self._name, "arv_camera_stop_acquisition", self._camera)
        finally:
            self._release()

    def take(self, timeout_s: float, use: Callable[[Delivered], None]) -> bool:
        """Hand over the oldest frame that was not taken; return False when none comes in time."""
        aravis = library()
        buffer = aravis.arv_stream_timeout_pop_buffer(self._stream, round(1e6 * timeout_s))
        if not buffer:
            return False
        try:
            status, size = aravis.arv_buffer_get_status(buffer), c_size_t()
            data = np.empty(0, np.uint8)
            if status == 0:
                start = aravis.arv_buffer_get_data(buffer, byref(size))
                data = np.ctypeslib.as_array(ctypes.cast(start, POINTER(ctypes.c_uint8)), (size.value,))
            time_ns = aravis.arv_buffer_get_timestamp(buffer)
            use(
                Delivered(
                    aravis.arv_buffer_get_frame_id(buffer),
                    time_ns / 1e9 if time_ns else None,
                    data,
                    "" if status == 0 else _STATUS.get(status, f"status {status}"),
                )
            )
        finally:
            aravis.arv_stream_push_buffer(self._stream, buffer)
        return True

    def close(self) -> None:
        """Let go of the camera."""
        self._release()
        if self._camera:
            library().g_object_unref(self._camera)
            self._camera = 0

    def _release(self) -> None:
        if self._stream:
            library().g_object_unref(self._stream)
            self._stream = None


def connect(camera: AravisSettings, context: DriverContext) -> GenicamCamera:
    """Open a camera.

    Raises
    ------
    ConfigurationError
        When Aravis is not installed.
    LinkLost
        When there is no such camera, or it does not answer.
    DeviceFault
        When it refuses what it is to be set to.
    """
    try:
        opened = _call(camera.name, "arv_camera_new", camera.device.encode())
    except LinkLost as error:
        raise LinkLost(f"{error}, and whether `arv-tool-0.8` lists '{camera.device}'") from error
    if library().arv_camera_is_gv_device(opened):
        # Sockets that see all packets of the interface need rights that a worker should not have.
        library().arv_camera_gv_set_stream_options(opened, _NO_PACKET_SOCKETS)
    stream = AravisStream(camera.name, opened)
    context.ending.callback(stream.close)
    features = AravisFeatures(camera.name, library().arv_camera_get_device(opened))
    return GenicamCamera(camera, features, stream, context.clock)


DRIVER = CameraDriver("aravis", AravisSettings, connect)
