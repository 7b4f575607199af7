"""Finds the words of words.toml in tracked files: ``python -m tests.style.words [PATH ...]``.

With paths, prints every place below them. Without, as `make lint` runs it, counts the places in
pending paths, prints all others, and fails if there is one.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_name("words.toml")
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Words:
    pending: tuple[str, ...]
    ignored: tuple[str, ...]
    #: Each word's regular expression and suggestion; and all words in one, which is faster.
    each: tuple[tuple[re.Pattern[str], str], ...]
    any: re.Pattern[str]

    @classmethod
    def of(cls, content: dict[str, Any]) -> Words:
        each = {_expression(word): suggestion for word, suggestion in content["words"].items()}
        return cls(
            tuple(content["pending"]),
            tuple(content["ignored"]),
            tuple((re.compile(expression), suggestion) for expression, suggestion in each.items()),
            re.compile("|".join(each)),
        )

    def places(self, path: str, text: str) -> Iterator[str]:
        """Each place in a file, as it is printed; line 0 is the path itself."""
        for number, line in enumerate([path, *text.splitlines()]):
            if self.any.search(line):
                for pattern, suggestion in self.each:
                    for match in pattern.finditer(line):
                        yield f"{path}:{number}: {match[0]!r}: {suggestion}"


def _expression(word: str) -> str:
    """The word between letters' ends; capitalised as well, unless it has a capital itself."""
    bare = re.sub(r"\\.", "", word)
    return rf"(?<![A-Za-z])(?{'i' if bare.islower() else ''}:{word})(?![A-Za-z])"


def below(path: str, paths: Sequence[str]) -> str | None:
    """Which of the paths a file is, or lies in."""
    return next((p for p in paths if path == p or path.startswith(p.rstrip("/") + "/")), None)


def main(chosen: Sequence[str]) -> int:
    words = Words.of(tomllib.loads(LIST.read_text("utf-8")))
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    failures, counts = [], Counter({path: 0 for path in words.pending})
    for path in listed.stdout.split("\0")[:-1]:
        if below(path, words.ignored) or not (ROOT / path).is_file():
            continue
        try:
            places = list(words.places(path, (ROOT / path).read_text("utf-8")))
        except UnicodeDecodeError:
            continue
        if chosen:
            failures += places if below(path, chosen) else []
        elif (pending := below(path, words.pending)) is not None:
            counts[pending] += len(places)
        else:
            failures += places
    if not chosen:
        for path, count in counts.items():
            print(f"words: {path}: {count or 'none: take it off the list of pending paths'}")
    print("\n".join(failures), end="\n" if failures else "")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
