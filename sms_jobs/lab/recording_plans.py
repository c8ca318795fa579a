"""Plans of recordings in a notebook: what is recorded next, and when."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sms_jobs.app.measuring.plan_wishes import PlanWish
from sms_jobs.lab.source import Source
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording


class RecordingPlans:
    """The plans of recordings of a home, here or at a server; `Lab.recordings` gives it.

    Parameters
    ----------
    source
        What it asks.
    """

    def __init__(self, source: Source) -> None:
        self._source = source

    def plan(
        self,
        campaign: str,
        states: Sequence[str] = (),
        *,
        at_cycles: Sequence[int] | None = None,
        stop_if: Sequence[str] = (),
        **wish: Any,
    ) -> list[PlannedRecording]:
        """Plan recordings behind those that are planned, as `sms acquire plan` does; return the whole plan.

        Give one thing to wait for: `every_s`, `at_cycles`, or `channel` with `tolerance`; without any, a
        state follows the one before it.

        Parameters
        ----------
        states
            Labels; all that are neither recorded nor planned nor skipped if there is none.
        at_cycles
            Numbers of cycles, a state at each; `channel` is then that which counts.
        stop_if
            Limits that hold the plan where a quick look finds them, as "g1.extension_mm > 0.5mm".
        wish
            `every_s`; `channel`, `tolerance` and `each`, as "load_n", "500N" and "10kN"; `hold_s`, `ask`,
            `process` and `look`: see docs/recording.md.

        Raises
        ------
        NotFound
            There is no such campaign, state or gauge; or the rig of the channel is not connected.
        Conflict
            A state is recorded, or being recorded; or nothing is left.
        InvalidInput
            What is waited for does not fit channel or states, or the campaign is a calibration session.
        """
        counts = None if at_cycles is None else tuple(at_cycles)
        wanted = PlanWish(tuple(states), at_cycles=counts, stop_if=tuple(stop_if), **wish)
        return self._source.plan_recordings(campaign, wanted)

    def show(self, campaign: str | None = None) -> list[PlannedRecording]:
        """Return the plan of a campaign, or all with something left; `NotFound` where there is no such."""
        return self._source.planned_recordings(campaign)

    def hold(self, campaign: str, states: Sequence[str] = ()) -> list[str]:
        """Hold planned recordings back, or the whole plan; return the states of which that is new.

        Raises
        ------
        NotFound
            There is no such campaign, or nothing is planned of such a state.
        Conflict
            One has already started.
        """
        return self._source.hold_recordings(campaign, states)

    def go(self, campaign: str, states: Sequence[str] = ()) -> list[str]:
        """Let recordings that were held back go on, and return their states; raises as `hold` does."""
        return self._source.release_recordings(campaign, states)

    def skip(self, campaign: str, states: Sequence[str] = ()) -> list[str]:
        """Leave planned recordings out, or the next one, and return their states.

        Raises `NotFound` where nothing is planned of such a state, `Conflict` where one has been recorded.
        """
        return self._source.skip_recordings(campaign, states)

    def move(self, campaign: str, state: str, before: str | None = None) -> None:
        """Let a planned recording come before another one, or last.

        Raises `NotFound` where nothing is planned of such a state, `Conflict` where one has already started.
        """
        self._source.move_recording(campaign, state, before)

    def drop(self, campaign: str, states: Sequence[str] = ()) -> Dropped:
        """Forget recordings of a plan, or all that do not run; return which, and what stays.

        Raises `NotFound` where nothing is planned of such a state, `Conflict` where one is being recorded.
        """
        return self._source.drop_recordings(campaign, states)
