"""Keys of the parts of the database in a design file: the arguments of their makers."""

from __future__ import annotations

from functools import cache
from inspect import Parameter, signature
from typing import Annotated, Any, get_type_hints

from pydantic import Field, StrictBool, create_model

from diffsim.copter.vehicle.parts.part import PartMaker
from diffsim.core import schema, schema_numbers


@cache
def option_keys(maker: PartMaker, base: type[schema.Part] = schema.FinitePart) -> type[schema.Part]:
    """A block with a key for each argument of a maker that its base does not have.

    Single numbers are sizes, masses, densities and factors: all of them above 0.

    Args:
        maker: Maker of a part; its annotations may be units of ``core.schema_numbers``.
        base: Keys that every part has.
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
