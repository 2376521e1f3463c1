"""Groups of options as one value: the command takes a dataclass, whose fields are options of the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, TypeVar, get_type_hints

R = TypeVar("R")


def flatten_options(command: Callable[..., R]) -> Callable[..., R]:
    """Return the command with each dataclass parameter replaced by its fields, as typer reads them.

    The fields have typer's annotations and defaults. The names of the fields are unique in the command.
    """
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        name: parameter.annotation
        for name, parameter in signature.parameters.items()
        if is_dataclass(parameter.annotation)
    }

    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        parameters += _of_fields(groups[name]) if name in groups else [parameter.replace(kind=_KEYWORD)]
    names = [parameter.name for parameter in parameters]

    @wraps(command)
    def run(*arguments: Any, **options: Any) -> R:
        values = dict(zip(names, arguments, strict=False)) | options
        for name, group in groups.items():
            field_names = [field.name for field in fields(group) if field.name in values]
            values[name] = group(**{field: values.pop(field) for field in field_names})
        return command(**values)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


_KEYWORD = inspect.Parameter.KEYWORD_ONLY


def _of_fields(group: Any) -> list[inspect.Parameter]:
    kinds = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(field.name, _KEYWORD, default=field.default, annotation=kinds[field.name])
        for field in fields(group)
    ]
