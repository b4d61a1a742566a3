"""Types of keys that name files: each says where these may lie; docs/security.md lists them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias

from diffsim.core.schema import KindWords


@dataclass(frozen=True)
class PathWords(KindWords):
    """What a type of keys that name files is called, and where these may lie.

    Attributes:
        words: Such as "text".
        reach: Where, in words; files of keys of ``INSIDE`` are opened by ``core.inside`` alone.
    """

    reach: str


INSIDE = "stays in its folder"
ANYWHERE = "may lie anywhere"
CODE = "stays in its folder, and is run as code"
NAMED_CODE = "is run as code where `--setup` names the same file"

PathInside: TypeAlias = Annotated[str, PathWords("text", INSIDE)]
FolderAnywhere: TypeAlias = Annotated[str, PathWords("text", ANYWHERE)]
