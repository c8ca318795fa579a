"""Notifications: who is told what, and whether it arrived."""

from __future__ import annotations

from fastapi.responses import HTMLResponse

from sms_jobs.app.accounts import notifications
from sms_jobs.records.shown.notifications import TOPICS
from sms_jobs.web.console import Entry, Page, Pages

PAGES = Pages("notifications", Entry("Notifications", "/notifications", 70))


@PAGES.show("/notifications", notifications.subscriptions)
def list_(page: Page) -> HTMLResponse:
    """List who is told what, and what was sent."""
    return page.render(
        "notifications.html",
        subscriptions=notifications.subscriptions(page.services),
        sent=notifications.sent(page.services, limit=100),
        topics=TOPICS,
    )
