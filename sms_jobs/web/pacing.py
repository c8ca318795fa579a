"""How long an open page rests before it asks again: all of them together get a share of the server."""

from __future__ import annotations

REST_HEADER = "X-Rest-Ms"
"""How long a page that follows events is to rest, in ms; `static/live.js` reads it."""
SHARE = 0.5
"""Of one processor, for all pages that follow events."""
SHORTEST_REST_S, LONGEST_REST_S = 0.1, 15.0


def rest_s(taken_s: float, pages: int) -> float:
    """Return how long a page rests that took so long to make, so that many of them leave room for others.

    Where each of n pages is made again and again in t and rests n t / `SHARE` in between, all of them take
    less than `SHARE` of the time. A page that nobody else is open beside, or that is made quickly, hardly
    rests; where the server is busy a page takes longer to make, and rests longer.

    Parameters
    ----------
    taken_s
        Time from the request to the answer, in s.
    pages
        That follow events now, this one included; counted as one if there is none.
    """
    wanted = taken_s * max(pages, 1) / SHARE
    return min(max(wanted, SHORTEST_REST_S), LONGEST_REST_S)
