"""Tables of refusals: inputs, and the words by which each refusal names what is wrong."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from pupper_sysid.common.errors import InputError


def refusal(use: Callable[..., object], *arguments: Any, **named: Any) -> str:
    """What `use` says when it refuses its arguments."""
    with pytest.raises(InputError) as refused:
        use(*arguments, **named)
    return str(refused.value)


def assert_each_refused(
    cases: Iterable[tuple[Any, str]], use: Callable[[Any], object], *, names: object = ""
) -> None:
    """Fail with all cases that `use` accepts, or refuses in other words.

    A refusal is an `InputError` of one line that is a sentence and has the words of its case and
    `names`, say the path of the file; words are looked for whatever their capitals.
    """
    problems = []
    for value, words in cases:
        shown = f"{value!r:.80}"
        try:
            use(value)
        except InputError as refused:
            text = str(refused)
            if "\n" in text or not text.endswith((".", "?", ".)")):
                problems.append(f"{shown}: no sentence: {text!r:.300}")
            problems += [
                f"{shown}: no {part!r} in {text!r:.300}"
                for part in (words, str(names)) if part.lower() not in text.lower()
            ]  # fmt: skip
        except Exception as error:
            problems.append(f"{shown}: {type(error).__name__}: {error}")
        else:
            problems.append(f"{shown}: accepted")
    assert not problems, "\n".join(problems)
