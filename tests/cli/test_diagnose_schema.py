"""The JSON Schema of a study: every published one fits, and misspelled keys do not."""

import json

import pytest
import yaml

from diffsim.cli import main
from diffsim.cli.arguments import described

KINDS = {
    "object": dict,
    "array": list,
    "string": str,
    "number": (int, float),
    "boolean": bool,
    "null": type(None),
}


@pytest.fixture(scope="module")
def schema(tmp_path_factory):
    path = tmp_path_factory.mktemp("schema") / "study.schema.json"
    assert main(["diagnose", "schema", "--out", str(path)]) == 0
    return json.loads(path.read_text())


def faults(schema, value, root, path="study"):
    """What does not fit, by the words of draft 7 that the schema has."""
    known = {"$ref", "anyOf", "allOf", "type", "enum", "items", "properties", "required"}
    known |= {"additionalProperties", "description", "if", "then", "else"}
    known |= {"$schema", "title", "$defs"}
    assert set(schema) <= known
    if "else" in schema:
        is_like = all(key in value for key in schema["if"]["required"])
        yield from faults(schema["then" if is_like else "else"], value, root, path)
    if "$ref" in schema:
        yield from faults(root["$defs"][schema["$ref"].removeprefix("#/$defs/")], value, root, path)
    if "anyOf" in schema:
        tried = [list(faults(one, value, root, path)) for one in schema["anyOf"]]
        if all(tried):
            yield min(tried, key=len)[0]
    for case in schema.get("allOf", ()):
        system = case["if"]["properties"]["system"]["const"]
        if value.get("system") == system:
            yield from faults(case["then"], value, root, path)
    kinds = schema.get("type", list(KINDS))
    if not any(isinstance(value, KINDS[k]) for k in ([kinds] if isinstance(kinds, str) else kinds)):
        yield f"{path}: {value!r} is no {kinds}"
        return
    if "enum" in schema and value not in schema["enum"]:
        yield f"{path}: {value!r} is none of {schema['enum']}"
    if isinstance(value, list) and "items" in schema:
        for k, part in enumerate(value):
            yield from faults(schema["items"], part, root, f"{path}[{k}]")
    if isinstance(value, dict):
        own = schema.get("properties", {})
        yield from (f"{path}: lacks {k}" for k in schema.get("required", ()) if k not in value)
        for key, part in value.items():
            inner = own.get(key, schema.get("additionalProperties", {}))
            if inner is False:
                yield f"{path}: no key {key}"
            else:
                yield from faults(inner, part, root, f"{path}.{key}")


@pytest.mark.parametrize("path", described(), ids=lambda path: path.stem)
def test_published_studies_fit(schema, path):
    assert not list(faults(schema, yaml.safe_load(path.read_text("utf-8")), schema))


def test_every_key_is_told(schema):
    keys = [
        (name, key)
        for name, block in schema["$defs"].items()
        for key, told in block.get("properties", {}).items()
        if len(told.get("description", "")) < 10
    ]
    assert not keys


def test_every_block_is_named_by_another(schema):
    """In a key, a list, a mapping: one that nothing leads to could hold any mistake."""

    def named(part):
        inner = part.values() if isinstance(part, dict) else part if isinstance(part, list) else ()
        own = {part} if isinstance(part, str) and part.startswith("#/$defs/") else set()
        return own.union(*map(named, inner))

    assert named(schema) == {f"#/$defs/{name}" for name in schema["$defs"]}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"chanels": []}, "no key chanels"),
        ({"runs": [{"nam": "a"}]}, "runs"),
        ({"model": {"system": "oed"}}, "none of"),
        ({"model": {"system": "ode", "sates": {}}}, "no key sates"),
        ({"channels": [{"unit": "m"}]}, "channels"),
        ({}, None),
    ],
)
def test_mistakes_are_marked(schema, change, says):
    good = {"name": "a", "model": {"system": "ode", "states": {"x": 0}, "rates": {"x": "-x"}}}
    good["model"]["readings"] = {"x": "x"}
    good |= {"channels": [{"name": "x", "unit": "m"}], "runs": [{"name": "a"}]}
    found = list(faults(schema, good | change, schema))
    assert any(says in fault for fault in found) if says else not found, found
