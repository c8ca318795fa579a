"""Documents of commands are read and compared as people read them."""

from __future__ import annotations

from pathlib import Path

from tests.support.console import alike, sections, shell

DOCUMENT = """# Title

## One

```console
$ echo a \\
>     b
a b
$ cat <<'END'
> two words
> END
two ...
```

Words.

```toml
$ no = command
```

## None
"""


def test_commands_and_what_they_print_are_read_and_run(tmp_path: Path) -> None:
    (heading,) = (found := sections(DOCUMENT))
    assert heading == "One"
    first, second = found["One"]
    assert (first.text, first.printed) == ("echo a \\\n    b", ["a b"])
    assert second.text == "cat <<'END'\ntwo words\nEND"
    with shell(tmp_path) as screen:
        for command in (first, second):
            assert alike(command.printed, screen.run(command.text))
        screen.run("export THERE=here")
        assert screen.run("echo $THERE >&2; cat") == "here\n"


def test_another_answer_is_noticed() -> None:
    assert alike([], "")
    assert alike(["a ... c", "..."], "a  b   c\nmore\nlines\n")
    assert not alike([], "something\n")
    assert not alike(["a", "b"], "a\n")
    assert not alike(["3 succeeded"], "2 succeeded\n")
