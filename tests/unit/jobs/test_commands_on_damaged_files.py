"""Commands that show, draw, export or pack a file say when it is not what was sealed, and write nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import select
from support.homes import make_home, stored
from support.sealing import regions

from sms_jobs import bootstrap
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.cli import archived, exporting, portable_data
from sms_jobs.errors import ArchiveCorrupt


@pytest.fixture
def damaged(home: Path) -> tuple[Path, int, int]:
    """A home with a dataset and a document, each with a byte that is another: the numbers of both."""
    make_home(home, {})
    with bootstrap.services(home) as services:
        dataset = stored(services, "segment", "plate/S00/C1P1", {"regions": regions()})
        document = stored(services, "report", "plate", None, 1)
        with services.catalogue.reading() as session:
            paths = session.scalars(select(FileRow.path).where(FileRow.id.in_((dataset, document)))).all()
        for path in paths:
            file = services.archive.store.path(path)
            file.chmod(0o644)
            file.write_bytes(file.read_bytes().replace(b"page", b"paga").replace(b'"area":9', b'"area":8'))
    return home, dataset, document


def test_nothing_is_shown_drawn_or_exported_of_them(damaged: tuple[Path, int, int], tmp_path: Path) -> None:
    home, *files = damaged
    out = tmp_path / "out"
    out.mkdir()
    for file in map(str, files):
        with pytest.raises(ArchiveCorrupt, match="is not what was sealed"):
            archived.show(file, home=home)
        with pytest.raises(ArchiveCorrupt, match="is not what was sealed"):
            exporting.export(file, out=out, home=home)
    dataset = str(files[0])
    for form in ("hdf5", "npz"):
        with pytest.raises(ArchiveCorrupt, match="is not what was sealed"):
            exporting.export(dataset, form=form, out=out, home=home)
    with pytest.raises(ArchiveCorrupt, match="is not what was sealed"):
        archived.plot(dataset, out=out / "a.png", home=home)
    assert list(out.iterdir()) == []
    with pytest.raises(ArchiveCorrupt, match="is not what was sealed"):
        portable_data.pack(campaign="plate", to=tmp_path / "packed", home=home)
