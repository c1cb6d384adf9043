"""What the devices are reached through."""

from __future__ import annotations

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, PrivateAttr, ValidationInfo, field_validator, model_validator

from dualcal_hal import registry

BACKENDS_ARE_KNOWN = "backends are known"
"""Key of the validation's context: where it is false no backend is looked up, as no device will be."""


class BackendEntry(BaseModel):
    """A backend and its options, which are those of its type."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    type: str
    """The backend's registered name, for instance simulator."""

    @field_validator("type")
    @classmethod
    def _is_registered(cls, value: str, info: ValidationInfo) -> str:
        if _are_known(info) and value not in registry.backend_names():
            raise ValueError(f"unknown backend '{value}'; there are: {', '.join(registry.backend_names())}")
        return value

    _checked: BaseModel = PrivateAttr()

    @model_validator(mode="after")
    def _options_fit(self, info: ValidationInfo) -> Self:
        if not _are_known(info):
            self._checked = _Unknown()
            return self
        try:
            backend = registry.backend_class(self.type)
        except ImportError as error:
            raise ValueError(f"backend '{self.type}' cannot be imported: {error}") from error
        self._checked = backend.Options.model_validate(self.options, context=info.context)
        return self

    @property
    def checked(self) -> BaseModel:
        """The options as the model of the backend's type."""
        return self._checked

    @property
    def options(self) -> dict[str, Any]:
        """The entry without its type, as written."""
        return dict(self.model_extra or {})


class _Unknown(BaseModel):
    """Options that nobody has looked at."""


def _are_known(info: ValidationInfo) -> bool:
    return bool((info.context or {}).get(BACKENDS_ARE_KNOWN, True))
