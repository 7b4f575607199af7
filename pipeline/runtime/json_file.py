"""Files that stages exchange or publish: each is one frozen model, written and read as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import rerun
from pipeline.runtime.text import shown

Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]

# Ten times the largest file of a scene of 10,000 photographs. Exports of others are read as well.
_MAX_BYTES = 512 << 20


class JsonObject(BaseModel):
    """An object in a file: unknown fields and numbers that are not finite are errors."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        json_schema_serialization_defaults_required=True,
    )


class JsonFile(BaseModel):
    """The content of a file in a stage's folder.

    Attributes:
        file_name: The name of the file.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    file_name: ClassVar[str]

    def write(self, folder: Path) -> None:
        """Write the file into ``folder``: the same content, the same bytes. Floats have the digits
        that give the same float when read."""
        write_json(folder / self.file_name, self.model_dump(mode="json"))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the file of the stage with this folder.

        Raises:
            UserError: the file is missing, truncated, or not valid for this model.
        """
        file = folder / cls.file_name
        what = (
            f"expected {cls.__name__} as this version of the program writes it, found a damaged "
            "file or one of another version"
        )
        if file.exists() and (not file.is_file() or file.stat().st_size > _MAX_BYTES):
            raise mismatch(file, f"expected a file of at most {_MAX_BYTES >> 20} MiB")
        try:
            content = cls.model_validate_json(file.read_bytes())
        except FileNotFoundError:
            raise mismatch(file, f"expected an output of stage {folder.name}, found none") from None
        except ValidationError as error:
            raise mismatch(file, f"{what} ({first_error(error)})") from None
        # Defaults are for those who make a content: a file has every field.
        if missing := sorted(cls.model_fields.keys() - content.model_fields_set):
            raise mismatch(file, f"{what} ({missing[0]}: Field required)")
        return content


def mismatch(file: Path, what: str) -> UserError:
    """The error for a file in a stage's folder that is not as expected; the remedy is to rerun the
    stage."""
    return UserError(what, file=file, fix=rerun(file.parent))


def first_error(error: ValidationError) -> str:
    """Where the first of the errors is, what was expected there and what was found."""
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    found = first["msg"]
    if first["type"] not in ("json_invalid", "missing"):
        found += f", found {shown(first['input'])}"
    return f"{where}: {found}" if where else found
