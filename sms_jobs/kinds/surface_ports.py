"""Where the surface of a view comes from; no other module knows which kind makes it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import MEASUREMENT, Inputs, Need, Port
from sms_jobs.kinds.products import CALIBRATION_FACTOR, MEASURED, PHASE, PLACES, SURFACE, Product
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import View, view_of


@dataclass(frozen=True)
class Maker:
    """A kind that makes surfaces.

    Attributes
    ----------
    kind
        Its name.
    products
        What it gives.
    views
        Says whose surface it makes.
    once
        Whether that of the reference state is that of every state.
    """

    kind: str
    products: tuple[Product[Any], ...]
    views: Callable[[View], bool]
    once: bool = False


MAKERS = (
    Maker(
        "stereo-fringes",
        (SURFACE, PHASE, CALIBRATION_FACTOR),
        lambda view: bool(view.projectors and view.other_cameras),
    ),
    Maker("reconstruct", (SURFACE, PHASE, CALIBRATION_FACTOR), lambda view: bool(view.projectors)),
    Maker("stereo", (SURFACE, CALIBRATION_FACTOR, PLACES), lambda view: bool(view.other_cameras)),
    Maker("plane", (SURFACE,), lambda view: not view.measures_shape, once=True),
)


def maker_of(view: str | None) -> Maker:
    """Return what makes the surface of a view; raise `InvalidInput` for what is no view."""
    seen = view_of(view)
    return next(maker for maker in MAKERS if maker.views(seen))


@dataclass(frozen=True)
class SurfacePort:
    """One port for surfaces, whatever makes them; `run` reads at `port`."""

    port: Port

    @property
    def all(self) -> tuple[Port, ...]:
        """The ports that a kind declares."""
        return tuple(self._made_by(maker) for maker in MAKERS)

    def of(self, campaign: Campaign, subject: Subject) -> Need:
        """Return the need for the surface of a tuple."""
        maker = maker_of(subject.view)
        state = campaign.reference.label if maker.once else subject.state
        return self._made_by(maker).of(replace(subject, state=state))

    def _made_by(self, maker: Maker) -> Port:
        products = tuple(product for product in self.port.products if product in maker.products)
        return replace(self.port, source=maker.kind, products=products)


def surface_port(
    name: str, products: tuple[Product[Any], ...] = (SURFACE,), *, several: bool = False
) -> SurfacePort:
    """Return a port for the surfaces of tuples."""
    return SurfacePort(Port(name, MAKERS[0].kind, products, several))


@dataclass(frozen=True)
class StatePorts:
    """Where the surface of a state comes in, and its frames."""

    surface: SurfacePort
    frames: Port

    @property
    def all(self) -> tuple[Port, ...]:
        """The ports that a kind declares."""
        return (*self.surface.all, self.frames)

    def of(self, campaign: Campaign, subject: Subject) -> Iterable[Need]:
        """Yield the needs of a state; of what is made once, the reference alone has the surface."""
        if not maker_of(subject.view).once or subject.state == campaign.reference.label:
            yield self.surface.of(campaign, subject)
        yield self.frames.of(textured_by(subject))

    def recorded(self, inputs: Inputs, about: Subject | None = None) -> Measurement:
        """Return what shows the texture of the job's tuple, or of another where the ports have several."""
        return inputs.read(self.frames, MEASURED, about and textured_by(about))


def textured_by(subject: Subject) -> Subject:
    """Return the recording that shows what the reference camera of a tuple sees."""
    return subject.recordings[0]


def state_ports(
    surface: str, frames: str, also: tuple[Product[Any], ...] = (), *, several: bool = False
) -> StatePorts:
    """Return the ports of a state, by their names; `also` is read of its surface's file."""
    return StatePorts(
        surface_port(surface, (SURFACE, PHASE, CALIBRATION_FACTOR, *also), several=several),
        Port(frames, MEASUREMENT, (MEASURED,), several),
    )


def position_covariance(surface: Surface) -> NDArray[np.floating]:
    """Return the covariance of positions, (6, rows, columns): none where pixels are where they are."""
    if surface.covariance is None:
        return np.zeros((6, *surface.reason.shape))
    return covariance_in_space(surface.covariance)


def independent_covariance(surface: Surface) -> NDArray[np.floating]:
    """Return what of `position_covariance` a mean over pixels makes less as if they were independent.

    Of positions that come from subsets nothing is independent, and what the texture hides cancels.
    """
    covariance = position_covariance(surface)
    if surface.subset_radius_px:
        return 0.0 * covariance
    return covariance if surface.texture_part is None else covariance * (1.0 - surface.texture_part)


def noise_covariance(surface: Surface) -> NDArray[np.floating]:
    """Return what of `position_covariance` differs between recordings of what stands still: the noise."""
    covariance = position_covariance(surface)
    return covariance if surface.noise_part is None else covariance * surface.noise_part


def bias_in_space(moved: DisplacementField) -> NDArray[np.floating] | None:
    """Return the part of a displacement's covariance (6, rows, columns) that is no noise; None for none."""
    return None if moved.bias is None else covariance_in_space(moved.bias)
