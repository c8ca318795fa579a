"""Values that no command expects, by the kind of value that it asks for."""

from __future__ import annotations

from random import Random

SECRET = "Zimtstern7261"  # noqa: S105 - of nothing
"""The password in every URL and setting; it must never be printed."""

TEXTS = (
    "",
    " ",
    "a" * 65,
    "a" * 201,
    "a" * 70_000,
    "\u00df" * 65,
    "\udcff\udcfe",
    "[/x]",
    "\\[/x]",
    "\\\\[/x]",
    "[bold]",
    "[link=file:///etc/passwd]here[/link]",
    "[red]a[/]",
    "\x1b[31mred\x1b[0m",
    "\x1b]0;title\x07",
    "\x9b31m",
    "a\x7fb\x00c".replace("\x00", ""),
    "\u202eback",
    "line\nline",
    "line\rline",
    "\t",
    "..",
    ".",
    "../..",
    "a/b/c/d",
    "/",
    "-",
    "--",
    "-1",
    "%s%n",
    "{}{0}{x.__class__}",
    "$(id)",
    "'; DROP TABLE job; --",
    "NULL",
    "None",
    "\U0001f527",
    "\ufeffbom",
    "1,2,3",
    "a=b",
    "=",
    "a=",
    "=a",
    "[1, 2",
    "{" * 5_000,
    "(" * 5_000,
    "(a+)+$",
    "**/*",
    "{state}{state}",
    "\u0661\u0662",
)

NUMBERS = (
    "0", "-0", "1", "-1", "2", "1.5", "1e308", "-1e308", "1e309", "1e-320", "nan", "inf", "-inf",
    "9223372036854775807", "9223372036854775808", "-9223372036854775809", "2147483647", "2147483648",
    "99999999999999999999999999", "1" + "0" * 400, "9" * 5000, "0x10", "1_000", "1e5", "\u0661", "", "many",
)  # fmt: skip

TIMES = (
    "0001-01-01T00:00:00+14:00",
    "0001-01-01T00:00:00Z",
    "9999-12-31T23:59:59-14:00",
    "9999-12-31T23:59:59Z",
    "0001-01-01",
    "9999-12-31",
    "0000-00-00",
    "2026-02-30",
    "2026-03-01T12:00:00",
    "2026-03-01T12:00:00+25:00",
    "2026-03-01T12:00:00+00:00:00.5",
    "2026-W10-7",
    "1900-01-01T00:00:00Z",
    "2262-04-12T00:00:00Z",
)

OF_A_NAME = {
    "cron": ("* * * * *", "0 0 31 2 *", "60 * * * *", "*/0 * * * *", "@reboot", "0-9999999 * * * *"),
    "every": ("1s", "0s", "-1s", "1e400d", "99999999999999d", "1d1d", "0.0000001s", "s", "999999999d"),
    "tolerance": ("500N", "500", "0N", "-1N", "5mm", "1e999N", "nanN", "5" * 400 + "N"),
    "hold": ("0s", "10s", "10", "-1s", "15m", "1e400h", "s"),
    "at_cycles": ("1,2", "2,1", "1k", ",", "-1", "9" * 400, "1," * 5_000, "\u0661"),
    "stop_if": ("g1.x_mm>1mm", "g1.x_mm > 1e999mm", "g1.x_mm<nanmm", "g1.x>1mm", "a." * 5_000 + "x_mm>1mm"),
    "load": ("20kN", "20", "20mm", "1e999MN", "kN", "-0N"),
    "older_than": ("1s", "0s", "-1d", "99999999999999d", "999999999d", "d", "1e400d"),
    "zone": ("Europe/London", "UTC", "../../etc/passwd", "/etc/passwd", "localtime", "Etc", "", "a\x01"),
    "time_zone": ("Europe/London", "../../etc/passwd", "Etc", "\udcff"),
    "query": (
        "strain where load_N > 0", "strain where load_N > 1e999", "where", "strain where", "strain where (",
        "strain where load_N > " + "9" * 400, "strain where created > 0001-01-01", "strain " * 2_000,
        "strain where created > 9999-12-31T23:59:59-14:00", "strain where " + "not " * 3_000 + "x = 1",
        "strain where " + "(" * 3_000, "strain where campaign ~ '(a+)+$'", "strain where x = '\x1b[31m'",
        "strain where file = 99999999999999999999", "strain order by", "measurement where time < 0001-01-01",
    ),
    "text": ("strain where load_N > 0", "strain where (", "strain where created > 0001-01-01"),
    "columns": ("file", "calibration", "file,file", ",", "param.method", "param.", "load_kN", "x" * 300),
    "listen": ("127.0.0.1:0", "127.0.0.1:port", "127.0.0.1", ":", "[::1]:x", "127.0.0.1:99999"),
    "address": ("127.0.0.1", "nowhere", "::", "999.1.1.1", "fe80::1%lo"),
    "raw": ("1280x1024x12", "999999x999999x16", "0x0x0", "1x1x99", "8x8x8+999999999"),
    "size": ("C1=1280x1024", "C1=0x0", "C1=99999999999999999999x1", "C1", "=1x1", "x", "small", "C1=1x"),
    "volume": ("0", "1e308", "nan"),
    "frames": ("fringes", "gray:999 white", "fringes:0", "skip:999@1e9", "fringes " * 500),
    "order": ("density step", "step step", "x", "orientation density step"),
    "pattern": ("{state}-{view}-{index}.png", "{state}", "{", "}", "{}", "(?P<a>", "{index}" * 50, "*" * 100),
    "densities": ("32,31,30", "fdr-64", "fdr-99999999999", "0", "-1", "1," * 5_000, "99999999999999999999"),
    "orientations": ("0,90", "nan", "1e999", "0," * 3_000),
    "parameter": (
        "strain.gauge_length_mm=1e999", "strain.gauge_length_mm=nan", "strain.gauge_length_mm=" + "9" * 5000,
        "correlate.method=\x1b[31m", "x.y=z", "strain.=1", ".=1", "correlate.region_of_interest=(0,0)",
        "correlate.subset_radius_px=99999999999999999999", "correlate.region_of_interest=" + "1,1 " * 5_000,
    ),
    "fields": ("deviation", "X,Y", ",", "\x1b[31m"),
    "mapping": ("a=load[kN]", "a", "=", "a=[/x]", "a=load[\x1b]"),
    "delimiter": (";", "\t", "", "\n", '"', "\r", "ab", "\u00df", " "),
    "decimal": (",", ".", "x"),
    "to_url": (
        f"postgresql+psycopg://sms:{SECRET}@127.0.0.1:1/x", f"postgresql+psycopg://sms:{SECRET}@127.0.0.1:port/x",
        f"oracle://scott:{SECRET}@127.0.0.1/x", f"mysql://u:{SECRET}@[::1/x", f"sqlite://{SECRET}", "sqlite:///",
        "sqlite:////dev/null/x", "sqlite:///things", f"postgresql://u:{SECRET}@127.0.0.1:1/x?sslmode=no",
        f"postgresql+psycopg://u:{SECRET}@127.0.0.1:99999/x", f"sqlite:///x?mode={SECRET}", "://",
        f"postgresql+psycopg://u:{SECRET}@127.0.0.1:1/x?{SECRET}=1",
    ),
    "target": ("front", "back", "middle"),
    "chessboard": ("9x6", "0x0", "99999999999x9", "-1x6", "2x2"),
    "unit": ("mm", "parsec", ""),
    "direction": ("1", "-1", "0", "7"),
    "only": ("S00", "S0[", "*", "["),
    "cameras": ("a=C1", "=", "a=C99999999999999999999", "a=P1", "a=C1,a=C2"),
    "camera": ("C1", "a=C1", "C0", "C99999999999999"),
    "snapshot": ("2026", "../", "*"),
    "start": ("0,0", "nan,nan", "1e308,1e308", "0", "0,0,0", "64,64"),
    "end": ("10,10", "-1e9,5", "inf,0", "100,100"),
}  # fmt: skip
"""What fits the name of an option, or nearly does."""

KNOWN = {
    "campaign": ("plate",),
    "after": ("plate",),
    "session": ("plate",),
    "state": ("S00", "S01"),
    "states": ("S00", "S01"),
    "view": ("C1P1", "C1P2"),
    "kind": ("strain", "measurement", "correlate"),
    "kinds": ("simulate", "reconstruct", "pipeline"),
    "words": ("simulate", "pipeline", "strain"),
    "file": ("1", "2", "5", "9", "12"),
    "other": ("3", "5"),
    "number": ("1",),
    "before": ("1",),
    "tuples": ("plate/S00/C1P1", "plate/S01/C1P1"),
    "what": ("plate", "5"),
    "rig": ("small-virtual-rig", "here"),
    "name": ("plate", "nightly", "mine"),
    "names": ("cpu", "io"),
    "record": ("fields", "phase", "strain", "displacement"),
    "field": ("xyz", "strain", "u", "exx"),
    "form": ("ply", "vtu", "csv", "npz", "matlab", "hdf5", "stl", "table", "lines", "json", "parquet"),
    "device": ("here/camera-C1",),
    "specimen": ("plate",),
    "image": ("things/frames/S00-C1P1-00.png",),
    "experiment": ("plate-tension", "top-hat-bending"),
    "style": ("opencv", "thesis"),
    "queues": ("cpu,io",),
    "reason": ("because",),
    "recorded_at": ("2026-03-01T12:00:00Z",),
    "valid_from": ("2026-03-01T12:00:00Z",),
    "at": ("2031-03-01T12:00:00Z",),
    "map": ("a=load[kN]",),
}
"""What exists in the home of a try, by the name of the option that asks for it."""


def hostile_text(rng: Random, name: str) -> str:
    """Return a text for an option of that name."""
    own = OF_A_NAME.get(name)
    if own is not None and rng.random() < 0.6:
        return rng.choice(own)
    kind = rng.random()
    if kind < 0.15 and name in KNOWN:
        word = rng.choice(KNOWN[name])
        place = rng.randrange(len(word) + 1)
        return word[:place] + rng.choice(TEXTS) + word[place:]
    if kind < 0.3:
        return rng.choice(TIMES)
    return rng.choice(NUMBERS) if kind < 0.45 else rng.choice(TEXTS)


def known_text(rng: Random, name: str) -> str:
    """Return a text that an option of that name can do something with, as far as one is known."""
    own = KNOWN.get(name) or OF_A_NAME.get(name)
    return rng.choice(own) if own else rng.choice(("1", "plate", "x"))
