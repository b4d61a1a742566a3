"""Keys that are the arguments of what they make: of parts in a design file, of rotors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from inspect import Parameter, signature
from typing import Annotated, Any, get_type_hints

from pydantic import Field, StrictBool, create_model

from diffsim.core import schema, schema_numbers


@cache
def option_keys(
    maker: Callable[..., Any], base: type[schema.Part] = schema.FinitePart
) -> type[schema.Part]:
    """A block with a key for each argument of a maker that its base does not have.

    Numbers that are ``float`` are sizes, masses, densities and factors: all of them above 0. What
    may be a tensor, too, is checked by what is made.

    Args:
        maker: Its annotations may be units of ``core.schema_numbers``.
    """
    hints = get_type_hints(maker, localns=vars(schema_numbers), include_extras=True)
    fields: dict[str, Any] = {
        name: (
            _positive(hints.get(name, Any)),
            ... if argument.default is Parameter.empty else argument.default,
        )
        for name, argument in signature(maker).parameters.items()
        if name not in base.model_fields
    }
    return create_model(maker.__name__, __base__=base, **fields)


def _positive(hint: Any) -> Any:
    if hint is bool:
        return StrictBool
    is_number = hint is float or getattr(hint, "__origin__", None) is float
    return Annotated[hint, Field(gt=0.0)] if is_number else hint
