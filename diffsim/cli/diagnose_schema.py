"""``diffsim diagnose schema``: JSON Schema of study.yaml, for editors."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.core.schema_json import definitions, name_of
from diffsim.core.version import __version__
from diffsim.data.study_schema import StudyFile
from diffsim.systems.registry import DESCRIPTIONS


def study_schema() -> dict[str, Any]:
    """Schema of a study: its keys, and those of ``model`` by the kind of system."""
    defs = definitions(StudyFile)
    cases = []
    for system, (module, name) in sorted(DESCRIPTIONS.items()):
        try:
            description = getattr(import_module(module), name)
        except ImportError:  # of an extra that is not installed: its keys are not known here
            continue
        defs |= definitions(description)
        cases.append(
            {
                "if": {"properties": {"system": {"const": system}}},
                "then": {"$ref": f"#/$defs/{name_of(description)}"},
            }
        )
    defs[name_of(StudyFile)]["properties"]["model"] = {
        "type": "object",
        "properties": {"system": {"enum": sorted(DESCRIPTIONS)}},
        "required": ["system"],
        "allOf": cases,
        "description": "Description of the system that was recorded",
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"study.yaml of diffsim {__version__}",
        "$ref": f"#/$defs/{name_of(StudyFile)}",
        "$defs": defs,
    }


def write_schema(out: Path) -> None:
    """Write the schema, and say the line that editors look for."""
    write_text_atomic(out, json.dumps(study_schema(), indent=1, ensure_ascii=False) + "\n")
    print(f"wrote {out}; the first line of a study then names it for editors:")
    print(f"# yaml-language-server: $schema={out}")
