"""How settings are declared: a frozen model whose fields have limits, a meaning and a unit, each said once.

The checks, the one-line errors and the help come from these declarations. A plugin declares its own in the
same way:

    class Config(TrainConfig):
        lr: AtLeast0 = key(1e-3, "Adam's learning rate")
        horizon: Count = key(8, "seen ahead", "steps", le=100)
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from uavnav.errors import MOST_WHOLE, ConfigError, among, told, unknown, unknown_key

STRICT = ConfigDict(strict=True, allow_inf_nan=False)
"""No text is a number, no number a name, and true is not 1."""


class Settings(BaseModel):
    """Settings that were checked when they were made, and stay as they are.

    Raises:
        ConfigError: there is no such setting, or a value has the wrong type, is out of range or not among the
            choices.
    """

    model_config = STRICT | ConfigDict(frozen=True, extra="forbid")

    def __init__(self, **given: Any) -> None:
        try:
            super().__init__(**given)
        except ValidationError as error:
            raise _refused(type(self), error) from None

    def model_post_init(self, context: Any) -> None:
        self.check()

    def check(self) -> None:
        """Raise a ConfigError where settings do not fit together."""

    @classmethod
    def names(cls) -> list[str]:
        """The names of all settings."""
        return list(cls.model_fields)

    def replace(self, **changes: Any) -> Self:
        """The same settings but for some, checked anew."""
        return type(self)(**dict(self) | changes)


def key(default: Any, what: str = "", unit: str = "", **limits: Any) -> Any:
    """A setting: its default, meaning and unit; limits: `ge`, `gt` and `le` as pydantic has them."""
    return Field(default, description=what, json_schema_extra={"unit": unit}, **limits)


# -- types of settings ---------------------------------------------------------------------------------------


def at_most(most: int) -> AfterValidator:
    """A limit that keeps the machine from harm, and that the help leaves out."""

    def check(value: float) -> float:
        if abs(value) > most:
            raise PydanticCustomError("too_large", "give a number of at most {most}", {"most": f"{most:,}"})
        return value

    return AfterValidator(check)


class OneOf:
    """Takes the names of a table, to which plugins may add."""

    def __init__(self, table: Collection[str]) -> None:
        self.table = table

    def __call__(self, name: str) -> str:
        if name not in self.table:
            raise PydanticCustomError("choices", "choose another")
        return name


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, BeforeValidator(_whole), at_most(MOST_WHOLE)]
"""A whole number, which may be written as 1e6."""
Count = Annotated[Whole, Field(ge=1)]
AtLeast0 = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=True)]
"""A time, or inf for never."""
_AsTuple = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
Units = Annotated[tuple[Whole, ...], _AsTuple]
"""Of each hidden layer."""
Numbers = Annotated[tuple[float, ...], _AsTuple]


# -- checks --------------------------------------------------------------------------------------------------

WANTED = {
    "bool_type": "choose from false, true",
    "finite_number": "give a number",
    "float_type": "give a number",
    "int_type": "give a whole number",
    "string_type": "give a name",
    "tuple_type": "give a list of numbers in brackets",
}
"""By pydantic's name of an error, what would be right."""
Part = TypeVar("Part", bound=Settings)


def checked(name: str, value: Any, hint: Any) -> Any:
    """The value in its declared type, or a ConfigError."""
    try:
        return TypeAdapter(hint, config=STRICT).validate_python(value)
    except ValidationError as error:
        raise _wrong(name, error.errors(include_url=False)[0], FieldInfo.from_annotation(hint)) from None


def part(kind: type[Part], name: str, given: Any) -> Part:
    """Settings that are one key of others, such as `world`, from a mapping of some of their fields."""
    if given is None or type(given) is kind:
        return given or kind()
    if isinstance(given, Settings):
        raise ConfigError(
            f"{name}={type(given).__name__}; give a {kind.__name__}, or a mapping of its fields"
        )
    if not isinstance(given, Mapping):
        first, field = next(iter(kind.model_fields.items()))
        raise ConfigError(
            f"{name}={told(given)}; give fields of the {name}, such as {name}.{first}={field.default}"
        )
    for one in given:
        if not among(one, kind.model_fields):
            raise unknown_key(f"{name}.{told(one)}", [f"{name}.{other}" for other in kind.model_fields])
    try:
        return kind(**given)
    except ConfigError as error:
        raise ConfigError(f"{name}.{error}") from error


def _refused(kind: type[Settings], error: ValidationError) -> ConfigError:
    """The first error of some settings, in one line."""
    first = error.errors(include_url=False)[0]
    if "error" in first.get("ctx", {}):  # of `check`, or of a validator of one's own
        return ConfigError(first["ctx"]["error"])
    name = str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return unknown_key(name, kind.names())
    place = [str(part) for part in first["loc"][1:] if isinstance(part, int)]  # in a list
    return _wrong(".".join([name, *place]), first, kind.model_fields[name])


def _wrong(name: str, error: ErrorDetails, field: FieldInfo) -> ConfigError:
    """A value that its field does not take, in one line that says what it takes."""
    if error["type"] in ("literal_error", "choices"):
        return unknown(name, error["input"], choices(field))
    given = told(error["input"])
    if error["type"] in ("greater_than", "greater_than_equal", "less_than_equal"):
        between = " and ".join(f"{said} {limit}" for said, limit in limits(field).items())
        return ConfigError(f"{name}={given}; give a number {between}")
    return ConfigError(f"{name}={given}; {WANTED.get(error['type'], error['msg'])}")


# -- what is said of them ------------------------------------------------------------------------------------


class Line(NamedTuple):
    """What is said of a key."""

    name: str
    default: str  # as on a command line
    unit: str
    meaning: str  # with the choices


def lines(kind: type[Settings], prefix: str = "") -> list[Line]:
    """What is said of each key; one that says nothing means what it meant in the class before."""
    found: list[Line] = []
    for name, field in kind.model_fields.items():
        before = (one.model_fields.get(name, field) for one in kind.__mro__ if issubclass(one, Settings))
        told: Any = next((one for one in before if one.description), field)
        names = getattr(kind, "PRESETS", ()) if name == "preset" else choices(field)
        meaning = "; ".join(filter(None, (told.description, _allowed(field, names))))
        unit = (told.json_schema_extra or {}).get("unit", "")
        found.append(Line(prefix + name, shown(field.default), unit, meaning))
    return found


def choices(field: FieldInfo) -> Collection[str]:
    """The names that a field takes, if it takes only names of some table."""
    if get_origin(field.annotation) is Literal:
        return get_args(field.annotation)
    tables = (one.func.table for one in _metadata(field) if isinstance(getattr(one, "func", None), OneOf))
    return ("false", "true") if field.annotation is bool else next(tables, ())


def limits(field: FieldInfo) -> dict[str, float]:
    """`{"of at least": 0, "at most": 1}`, or `above`: between what a number must be."""
    said = {"gt": "above", "ge": "of at least", "le": "at most"}
    return {
        word: getattr(one, name)
        for name, word in said.items()
        for one in _metadata(field)
        if hasattr(one, name)
    }


def _allowed(field: FieldInfo, names: Collection[str]) -> str:
    """`relu, tanh`, `at least 1`, `0 to 1 or null`: what a value may be, where that is more than its type."""
    between = limits(field)
    if names:
        allowed = ", ".join(sorted(names))
    elif list(between) == ["of at least", "at most"]:
        allowed = " to ".join(map(str, between.values()))
    else:
        allowed = " and ".join(f"{said.removeprefix('of ')} {limit}" for said, limit in between.items())
    if type(None) in get_args(field.annotation) and str not in get_args(field.annotation):
        return f"{allowed or 'a number'} or null"
    return allowed


def _metadata(field: FieldInfo) -> list[Any]:
    """What limits a field, and what limits the number in `Count | None`."""
    kinds = get_args(field.annotation)
    inner = FieldInfo.from_annotation(kinds[0]).metadata if type(None) in kinds else []
    return [*field.metadata, *inner]


def shown(value: Any) -> str:
    """A value as a command line gives it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"[{','.join(map(shown, value))}]" if isinstance(value, (list, tuple)) else str(value)


def flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with a name for each field of a part, as a command line gives them: `world.sensor_arc`."""
    parts = {name: value for name, value in settings.items() if isinstance(value, Mapping)}
    own = {f"{part}.{name}": value for part, fields in parts.items() for name, value in fields.items()}
    return {name: value for name, value in settings.items() if name not in parts} | own


def differing(settings: Iterable[Mapping[str, Any]]) -> set[str]:
    """The settings that are not the same everywhere."""
    pairs = itertools.pairwise(settings)
    return {key for one, other in pairs for key in {*one, *other} if one.get(key) != other.get(key)}
