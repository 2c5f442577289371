"""For the built site: our ``Example:`` is what the docstring parser calls ``Examples:``, code that is shown as code."""

from __future__ import annotations

import re
from typing import Any

import griffe

TITLE = re.compile(r"^(\s*)Example:(?=\s*$)", re.MULTILINE)


class Examples(griffe.Extension):
    """Renames the section where it is a block of its own."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every object that is documented."""
        if obj.docstring is not None:
            obj.docstring.value = TITLE.sub(r"\1Examples:", obj.docstring.value)
