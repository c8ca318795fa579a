"""Files of one content that are to be recordings of different states or cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.jobs.archiving.importing import ImportedFile
from sms_jobs.records.sizes import number_of
from sms_jobs.records.views import view_of

_NAMED = 3


def remarks_on_copies(good: Sequence[Inspected], before: Iterable[ImportedFile]) -> list[str]:
    """Return a remark on images of one content, which no camera records twice; none where there are none.

    One state may share a camera's image among its views. Blank images and patterns of a code, of which little
    may be seen, can be alike by chance, and a black frame serves many states.

    Parameters
    ----------
    before
        What the campaign's measurements in the archive were made of.
    """
    files: dict[str, dict[tuple[str, str], str]] = {}
    for one in good:
        recorded = {*one.found.fringes, *([] if one.found.white is None else [one.found.white])}
        for name, about in one.facts.items():
            if name in recorded and about.at_highest < 1.0:
                of = one.found.state, view_of(one.found.view).camera
                files.setdefault(about.sha256, {}).setdefault(of, name)
    # To know them takes a file of each tuple.
    for known in before if files else ():
        if known.sha256 in files:
            of = str(known.subject.state), view_of(str(known.subject.view)).camera
            files[known.sha256].setdefault(of, f"{known.name} of {known.subject}, imported before,")
    groups = [list(names.values()) for names in files.values() if len(names) > 1]
    if not groups:
        return []
    first, more = " and ".join(groups[0][:_NAMED]), len(groups) - 1
    besides = f", and so have those of {number_of(more, 'other group')}" if more else ""
    remark = (
        f"{first} have the same content{besides}: noise alone tells two recordings apart, so one file was "
        "copied over another, and nothing measured would be found between them"
    )
    return [remark]
