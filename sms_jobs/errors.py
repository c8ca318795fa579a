"""The exceptions of `sms_jobs`: what went wrong, who can fix it, and whether trying again can help.

The exit code of the command line and the retry policy of the job service follow from the class alone.
A message is one sentence that names the thing, the value, the limit with its unit, and the next step.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import ClassVar


class SmsError(Exception):
    """Base of every error that `sms_jobs` raises on purpose.

    Attributes
    ----------
    exit_code
        What the `sms` command returns.
    retryable
        True when the same work may succeed if it is tried again with nothing changed.
    """

    exit_code: ClassVar[int] = 1
    retryable: ClassVar[bool] = False


class InvalidInput(SmsError):
    """A value that a person gave cannot be used; nothing was changed."""

    exit_code = 2


class ConfigurationError(InvalidInput):
    """A setting or a configuration file cannot be used."""


class CatalogueEmpty(ConfigurationError):
    """There is no catalogue, or one without tables."""


class NotFound(SmsError):
    """A campaign, state, job, calibration or file that was named does not exist."""

    exit_code = 3


class Conflict(SmsError):
    """The thing exists already, is locked, or is in a state that forbids what was asked."""

    exit_code = 4


class NotAllowed(SmsError):
    """Whoever asks may not do that."""

    exit_code = 8


class PasswordNeeded(NotAllowed):
    """It is done only by somebody who has just given the password again."""


class DevicesBusy(Conflict):
    """A device is in use by somebody else; it may be free later."""

    retryable = True


class PlanOutdated(Conflict):
    """What a plan builds on was changed by somebody else before it was entered."""

    retryable = True


class JobFailed(SmsError):
    """A job that was waited for did not succeed."""

    exit_code = 5


class ArchiveCorrupt(SmsError):
    """A file of the archive is missing, truncated, or differs from its recorded hash."""

    exit_code = 6


class CatalogueDamaged(SmsError):
    """The catalogue's file is damaged, emptied or gone; the archive can tell what was in it."""

    exit_code = 6


class OtherFormat(SmsError):
    """A file, message or catalogue was written by a version that this one does not read."""

    exit_code = 4


class ServerUnreachable(SmsError):
    """A database or broker does not answer."""

    exit_code = 7
    retryable = True


class NotDelivered(ServerUnreachable):
    """A mail server or webhook does not take a notification."""


class CatalogueBusy(ServerUnreachable):
    """Others have been writing to the catalogue for longer than is waited for; it may be free later."""


class CommitInDoubt(ServerUnreachable):
    """A database went away while it committed: nobody knows whether it did."""


class StorageFull(SmsError):
    """The disk that holds the archive or the catalogue has no room left."""

    exit_code = 7
    retryable = True


class StorageUnusable(SmsError):
    """The disk or share that holds the archive is read-only, gone, failing, or forbidden to this account."""

    exit_code = 7
    retryable = True


class FileTooLarge(StorageUnusable):
    """The archive's file system, or a limit of this account, takes no file so large."""

    retryable = False


class WaitTimedOut(SmsError):
    """What was waited for did not happen in time; the work goes on."""

    exit_code = 124


class MeasurementFailed(SmsError):
    """The data hold no answer: no texture, no valid pixel, no overlap, no common region."""


class CalibrationFailed(SmsError):
    """A calibration cannot be found from what was observed; the message names what the data leave open."""


class Cancelled(SmsError):
    """The job was asked to stop and did."""


class OverLimit(Cancelled):
    """The job took more time or memory than a job may have, and was stopped."""


class LeaseLost(SmsError):
    """Another worker holds the job now; this attempt's outputs are discarded."""


class InstrumentError(SmsError):
    """An instrument does not do what it was told; a person has to look at it."""

    exit_code = 7


class LinkLost(InstrumentError):
    """An instrument does not answer, or only noise comes back: its cable, power, port or settings."""


class LimitExceeded(InstrumentError):
    """An instrument was told to go where it must not, or stopped there."""


class DeviceFault(InstrumentError):
    """An instrument answers, and says that it failed or refuses: a servo, a voltage, an unknown command."""


class FrameLost(InstrumentError):
    """A camera did not deliver a frame that was triggered; the pattern can be shown again."""


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.7) -> str:
    """Return how an error asks whether a name that there is was meant, with "; " behind it; "" for none.

    `cutoff` is how alike the two are, from 0 to 1, whatever their letters' case.
    """
    written = {one.lower(): one for one in known}
    near = get_close_matches(name.lower(), written, 1, cutoff)
    return f"did you mean '{written[near[0]]}'; " if near else ""


def in_words(message: str) -> str:
    """Return what a validator says of a value as a person would say it."""
    for technical, plain in _PLAIN.items():
        message = message.replace(technical, plain)
    return message


_PLAIN = {
    "Value error, ": "",
    "Input should": "it should",
    "Tuple should": "it should",
    "List should": "it should",
    "String should": "it should",
    " after validation": "",
    ", unable to parse string as an integer": "",
    ", unable to parse string as a number": "",
    ", got a number with a fractional part": "",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid list": "a list",
    "a valid tuple": "a list",
    "a valid dictionary or object to extract fields from": "an object",
    "a valid dictionary": "an object",
    "a valid string": "text",
    "a valid boolean, unable to interpret input": "true or false",
    "a valid boolean": "true or false",
}
