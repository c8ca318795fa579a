"""The calibration that a job is given: the one that holds for what was measured, or why there is none."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, search
from sms_jobs.catalogue.valid_calibrations import UsedCalibration, ValidCalibrations
from sms_jobs.errors import NotFound
from sms_jobs.records.shown.times import valid_from
from sms_jobs.records.subject import Subject


def holding(session: Session, valid: ValidCalibrations, rig: str, subject: Subject) -> UsedCalibration | None:
    """Return the calibration that holds for a subject; None where nothing is known of any of its rig.

    Raises
    ------
    NotFound
        There are some, and none of them is used, or became valid in time.
    """
    found = valid.of(subject)
    if found is not None:
        return found
    if valid.used:
        first, at = valid.used[0], valid.time_of(subject).isoformat(" ", "seconds")
        raise NotFound(
            f"{subject} is of {at}, and the first calibration that is used for "
            f"it, {first.number}, is {valid_from(first.valid_from)}: import or certify one that is valid "
            "from an earlier time"
        )
    waiting = [view.id for view in search.list_calibrations(session, rig) if not view.in_use]
    if not waiting:
        return None
    raise NotFound(
        f"{subject} needs a calibration of rig {rig}, and none is in use for that rig; "
        f"'sms calibration accept {waiting[0]}' takes the latest into use, 'sms calibration list' shows all"
    )


def chosen(session: Session, subject: Subject, now: datetime) -> UsedCalibration | None:
    """Return the calibration that holds for a subject; None where there is none."""
    campaign_id = campaigns.campaign_id(session, subject.campaign)
    return ValidCalibrations(session, campaign_id, now, subject.state).of(subject)
