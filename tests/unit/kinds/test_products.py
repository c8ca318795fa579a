"""How records are called in their files, and how they are read from them."""

from __future__ import annotations

import pytest

from sms_jobs.kinds import all_kinds, products
from sms_jobs.kinds.products import MERGED, MESH, SURFACE, Product
from sms_jobs.records.record_names import RecordName
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory

EVERY = [one for one in vars(products).values() if isinstance(one, Product)]


@pytest.mark.parametrize("key", ["", "C1", "other_campaign", "before_1"])
def test_a_record_is_called_by_its_name_and_key(key: str) -> None:
    for product in EVERY:
        keyed = product.of(key)
        assert RecordName.parse(keyed.stored_as) == RecordName(product.name, key)
        assert product.among([keyed.stored_as]) == (keyed,)
        assert keyed.any_key == product


def test_kinds_give_and_take_what_is_listed_there() -> None:
    kinds = all_kinds().values()
    given = {one for kind in kinds for one in kind.records}
    taken = {one for kind in kinds for port in kind.inputs for one in port.products}
    assert given | taken == set(EVERY)


def test_a_record_is_read_where_a_file_has_it() -> None:
    # Nothing is asked of them but that they are of their sort, and the same.
    surface, merged = (object.__new__(product.record) for product in (SURFACE, MERGED))
    dataset = InMemory(Subject("wing", "S01"), {"surface": surface, "merged_C1": merged})
    assert SURFACE.read(dataset) is surface
    assert [one.read(dataset) for one in MERGED.among(dataset.names)] == [merged]
    assert (MESH.is_in(dataset), MESH.read_if_there(dataset)) == (False, None)
    assert not MERGED.is_in(dataset)
