"""Work that is submitted for all states that meet a question, across campaigns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from sms_jobs.app.rules import use_case
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Refusal, Submitted, Work
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.asking.found_states import states_to_submit
from sms_jobs.records.people import Right


@dataclass(frozen=True)
class SubmittedOfMany:
    """What was submitted of each campaign, or would be.

    Attributes
    ----------
    campaigns
        By name; states that are left out are told with each.
    refused
        Campaigns that are left out as a whole.
    """

    campaigns: Mapping[str, Submitted]
    refused: tuple[Refusal, ...]

    @property
    def counted(self) -> dict[str, int]:
        """How many jobs of each kind, over all campaigns."""
        total: dict[str, int] = {}
        for done in self.campaigns.values():
            for kind, count in done.counted.items():
                total[kind] = total.get(kind, 0) + count
        return total

    @property
    def all_refused(self) -> tuple[Refusal, ...]:
        """Everything that is left out."""
        return (*self.refused, *(one for done in self.campaigns.values() for one in done.refused))


@use_case(Right.COMPUTE)
def submit_found(services: Services, where: str, work: Work, *, dry_run: bool = False) -> SubmittedOfMany:
    """Submit work for the states that meet a question, campaign by campaign.

    What is about a whole campaign, as its report, is submitted where all of its states meet it.

    Parameters
    ----------
    where
        In the language of docs/query.md.
    work
        Without a campaign and states; these come from the question.

    Raises
    ------
    InvalidInput
        The question cannot be understood, or work names states itself.
    NotFound
        No state meets the question.
    SmsError
        What `new_jobs.submit` raises, where no campaign is left.
    """
    if work.campaign or work.states:
        raise InvalidInput("states come from the question; leave out the campaign and the states")
    with services.catalogue.reading() as session:
        found = states_to_submit(session, where)
    done: dict[str, Submitted] = {}
    refused: dict[str, InvalidInput | NotFound] = {}
    for campaign, states in found.items():
        try:
            own = replace(work, campaign=campaign, states=states)
            done[campaign] = new_jobs.submit(services, own, dry_run=dry_run)
        except (InvalidInput, NotFound) as error:
            refused[campaign] = error
    if not done:
        raise next(iter(refused.values()))
    return SubmittedOfMany(done, tuple(Refusal(name, str(error), {}) for name, error in refused.items()))
