"""Devices from what a rig file says: the one place that knows which driver belongs to which protocol."""

from __future__ import annotations

from sms_jobs.errors import ConfigurationError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.devices.pan_tilt import PanTilt
from sms_jobs.instruments.devices.scalar_channels import FileScalar, SerialScalar
from sms_jobs.instruments.devices.trigger_controller import TriggerBox, VideoSwitch
from sms_jobs.instruments.drivers.axes import Axes
from sms_jobs.instruments.drivers.line_device import LineDevice, ScalarInstrument
from sms_jobs.instruments.drivers.powercube import PowerCubeAxes, PowerCubes
from sms_jobs.instruments.drivers.ptu46 import Ptu46, PtuAxes
from sms_jobs.instruments.drivers.schunk_motion import MotionAxes, SchunkMotion
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.instruments.simulated.serial.simulation import SerialInstrument, SerialSimulation
from sms_jobs.instruments.transports.serial_port import SerialPort
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.instruments import (
    FileChannel,
    SerialChannel,
    Stage,
    TriggerController,
    VideoSplitter,
)
from sms_jobs.records.serial_links import SIMULATED


class Connector:
    """Makes devices on one clock, with one log.

    Parameters
    ----------
    simulation
        Of the instruments whose port is `simulated`; None where there are none.
    """

    def __init__(
        self, clock: Clock, log: OperationLog | None = None, simulation: SerialSimulation | None = None
    ) -> None:
        self._clock = clock
        self._log = log or OperationLog(clock)
        self._simulation = simulation

    def transport(self, instrument: SerialInstrument) -> Transport:
        """Return the wire to an instrument.

        Raises
        ------
        LinkLost
            Its port cannot be opened.
        ConfigurationError
            It is simulated, and there is no simulation.
        """
        if instrument.link.port != SIMULATED:
            return SerialPort(instrument.name, instrument.link)
        if self._simulation is None:
            raise ConfigurationError(
                f"'{instrument.name}' is simulated, but there is no simulation: name its port in the rig file"
            )
        return self._simulation.wire(instrument.name)

    def axes(self, stage: Stage) -> Axes:
        """Return the driver of a stage's axes."""
        transport = self.transport(stage)
        if stage.protocol == "powercube":
            cubes = PowerCubes(stage.name, transport, self._clock, stage.link, stage.checksum)
            return PowerCubeAxes(stage, cubes)
        if stage.protocol == "schunk-motion":
            return MotionAxes(stage, SchunkMotion(stage.name, transport, self._clock, stage.link))
        return PtuAxes(stage, Ptu46(stage.name, transport, self._clock, stage.link))

    def stage(self, stage: Stage) -> PanTilt:
        """Return a pan-tilt stage, not connected yet."""
        return PanTilt(stage, self.axes(stage), self._clock, self._log)

    def trigger_controller(self, settings: TriggerController) -> TriggerBox:
        """Return a trigger controller, not connected yet."""
        return TriggerBox(settings, self._line_device(settings), self._clock, self._log)

    def video_splitter(self, settings: VideoSplitter) -> VideoSwitch:
        """Return a video splitter, not connected yet."""
        return VideoSwitch(settings, self._line_device(settings), self._clock, self._log)

    def channel(self, channel: SerialChannel | FileChannel) -> SerialScalar | FileScalar:
        """Return a scalar channel, not connected yet."""
        if isinstance(channel, FileChannel):
            return FileScalar(channel, self._clock, self._log)
        instrument = ScalarInstrument(channel, self.transport(channel), self._clock)
        return SerialScalar(channel, instrument, self._clock, self._log)

    def _line_device(self, settings: TriggerController | VideoSplitter) -> LineDevice:
        transport = self.transport(settings)
        return LineDevice(settings.name, transport, self._clock, settings.link, settings.protocol)
