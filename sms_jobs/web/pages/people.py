"""People who have a name here, for administrators."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app.accounts import people
from sms_jobs.records.people import Right, Role
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("people", Entry("People", "/people", 80, Right.ADMINISTER))


@PAGES.show("/people", people.list_people)
def list_(page: Page) -> HTMLResponse:
    """List everybody."""
    return page.render("people.html", people=people.list_people(page.services), roles=list(Role))


@PAGES.show("/people/{name}", people.list_people)
def show(page: Page, name: str) -> HTMLResponse:
    """Show somebody, and what lets that person in."""
    access = people.list_access(page.services, name)
    found = next(one for one in people.list_people(page.services) if one.name == name)
    return page.render("person.html", person=found, access=access, roles=list(Role))
