"""The shell commands of the pages that users read."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

from tests.e2e.harness import ROOT

PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "docs/tutorial.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs" / "guides").glob("*.md")),
)

CHECKED = ("make", "python", "snakemake", "splatmake")

NOT_CHECKED = {
    "auditwheel": "needs a wheel and patchelf",
    "cibuildwheel": "needs a container engine",
    "cp": "the user's files",
    "docker": "needs a container engine",
    "mkdir": "the user's files",
    "pip": "installs packages; tests/install installs the program",
    "pre-commit": "changes the checkout's hooks; it runs make lint",
    "source": "changes the shell",
}
"""Programs whose commands are not checked, and why."""


@dataclass(frozen=True)
class Command:
    page: str
    text: str

    @property
    def words(self) -> list[str]:
        """The command and its arguments, without variables that are set before it."""
        words = shlex.split(self.text, comments=True)
        while "=" in words[0]:
            words.pop(0)
        return words

    @property
    def program(self) -> str:
        return self.words[0]


def commands() -> Iterator[Command]:
    """Indented commands, and those between backquotes that have arguments."""
    programs = "|".join(map(re.escape, (*CHECKED, *NOT_CHECKED)))
    command = rf"(?:[A-Z_]+=\S+ )?(?:{programs}) [^`\n]+"
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(), flags=re.S | re.M)
        for line in re.findall(rf"^    ({command})$|`({command})`", text, re.M):
            for part in "".join(line).split(" && "):
                yield Command(page, part)
