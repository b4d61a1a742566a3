"""How answers are put into words."""

import re

_NEXT = r"(?<=\.) (?=Not certain: |No gain is known: |The stated noise )"


def first_of(headline: str) -> str:
    """The first sentence of a headline."""
    return re.split(_NEXT, headline)[0]
