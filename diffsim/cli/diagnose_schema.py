"""``diffsim diagnose schema``: JSON Schema of study.yaml, for editors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.core.schema_json import definitions, name_of
from diffsim.core.version import __version__
from diffsim.data.study_schema import StudyFile
from diffsim.systems.registry import description_class, known_systems

LIKE = "_like"  # of definitions that another study completes


def study_schema() -> dict[str, Any]:
    """Schema of a study: its keys, and those of ``model`` by the kind of system."""
    defs = definitions(StudyFile)
    cases = []
    for system in sorted(known_systems()):
        try:
            description = description_class(system)
        except ImportError:  # of an extra that is not installed: its keys are not known here
            continue
        defs |= definitions(description)
        cases.append(
            {
                "if": {"properties": {"system": {"const": system}}, "required": ["system"]},
                "then": {"$ref": f"#/$defs/{name_of(description)}"},
            }
        )
    defs[name_of(StudyFile)]["properties"]["model"] = {
        "type": "object",
        "properties": {"system": {"enum": sorted(known_systems())}},
        "required": ["system"],
        "allOf": cases,
        "description": "Description of the system that was recorded",
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"study.yaml of diffsim {__version__}",
        "if": {"required": ["like"]},
        "then": {"$ref": f"#/$defs/{name_of(StudyFile)}{LIKE}"},
        "else": {"$ref": f"#/$defs/{name_of(StudyFile)}"},
        "$defs": defs | {name + LIKE: _lacking(one) for name, one in defs.items()},
    }


def _lacking(schema: Any) -> Any:
    """The same schema of a study that is like another one, which has what this one lacks."""
    if isinstance(schema, list):
        return [_lacking(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: part if key == "if" else f"{part}{LIKE}" if key == "$ref" else _lacking(part)
        for key, part in schema.items()
        if not (key == "required" and isinstance(part, list))
    }


def write_schema(out: Path) -> None:
    """Write the schema, and say the line that editors look for."""
    write_text_atomic(out, json.dumps(study_schema(), indent=1, ensure_ascii=False) + "\n")
    print(f"wrote {out}; the first line of a study then names it for editors:")
    print(f"# yaml-language-server: $schema={out}")
