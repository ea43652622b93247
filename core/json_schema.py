"""JSON schemas of files, for editors that complete and check YAML while it is written.

A schema accepts every file that the validators accept, and some more: limits that depend on other keys are left out.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

#: Validators of whole sections; those of values take other forms too, such as numbers without a point as text.
_STRICT = {"_only_known_keys", "_check"}


class _Generator(GenerateJsonSchema):
    """Schemas in which values may have the forms that validators convert, and the kind of a section is a constant."""

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> JsonSchemaValue:
        inner = self.generate_inner(schema["schema"])
        if getattr(schema["function"]["function"], "__name__", "") in _STRICT or not inner:
            return inner
        return {"anyOf": [inner, {"type": ["string", "array"]}]}

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        key: Any = schema.get("metadata", {}).get("tag_key")
        choices = []
        for tag, choice in schema["choices"].items():
            inner = self.generate_inner(choice)
            kind = str(tag).strip("<>")
            # A sum of shapes is a list, not a kind.
            tagged = key and kind != "sum"
            choices.append({"allOf": [inner, {"properties": {key: {"const": kind}}}]} if tagged else inner)
        return {"anyOf": choices}


def json_schema(model: type[BaseModel], title: str) -> dict[str, Any]:
    """Return the JSON schema of a file."""
    schema = model.model_json_schema(schema_generator=_Generator)
    return {"$schema": _Generator.schema_dialect, **schema, "title": title}
