"""One's own account: who one is here, the password, and what lets one in."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app.accounts import identity, people
from sms_jobs.errors import NotFound
from sms_jobs.web.console import Page, Pages

PAGES = Pages("account")


@PAGES.show("/account", identity.who)
def account(page: Page) -> HTMLResponse:
    """Show whoever asks their account."""
    try:
        access = people.list_access(page.services)
    except NotFound:
        access = None  # whoever sits at the desk has no name
    return page.render("account.html", who=identity.who(page.services), access=access)
