"""Where the surface of a view comes from: fringes give one of every state, a camera alone has its image's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import MEASUREMENT, Need, Port
from sms_jobs.kinds.products import MEASURED, PHASE, SURFACE, Product
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import Surface
from sms_jobs.records.views import view_of

_MEASURED_BY, _PLANE_OF = "reconstruct", "plane"


class SurfacePort(NamedTuple):
    """One port for surfaces, whatever makes them: `run` reads at either."""

    measured: Port
    plane: Port

    @property
    def port(self) -> Port:
        """What `run` asks by: both have one name."""
        return self.measured

    def of(self, campaign: Campaign, subject: Subject) -> Need:
        """Return the need for the surface of a tuple; the plane of an image is that of its reference."""
        if view_of(subject.view).measures_shape:
            return self.measured.of(subject)
        return self.plane.of(replace(subject, state=campaign.reference.label))


def surface_port(
    name: str, products: tuple[Product[Any], ...] = (SURFACE,), *, several: bool = False
) -> SurfacePort:
    """Return a port for the surfaces of tuples."""
    port = Port(name, _MEASURED_BY, products, several)
    return SurfacePort(port, replace(port, products=(SURFACE,)).made_by(_PLANE_OF))


class StatePorts(NamedTuple):
    """Where the surface of a state comes in, and its frames."""

    surface: SurfacePort
    frames: Port

    @property
    def all(self) -> tuple[Port, ...]:
        """The ports that a kind declares."""
        return (*self.surface, self.frames)

    def of(self, campaign: Campaign, subject: Subject) -> Iterable[Need]:
        """Yield the needs of a state; a plane is that of the reference, and no other state has one."""
        if view_of(subject.view).measures_shape or subject.state == campaign.reference.label:
            yield self.surface.of(campaign, subject)
        yield self.frames.of(subject)


def state_ports(surface: str, frames: str, *, several: bool = False) -> StatePorts:
    """Return the ports of a state, by their names."""
    return StatePorts(
        surface_port(surface, (SURFACE, PHASE), several=several),
        Port(frames, MEASUREMENT, (MEASURED,), several),
    )


def position_covariance(surface: Surface) -> NDArray[np.floating]:
    """Return the covariance of positions, (6, rows, columns): none where pixels are where they are."""
    if surface.covariance is None:
        return np.zeros((6, *surface.reason.shape))
    return covariance_in_space(surface.covariance)
