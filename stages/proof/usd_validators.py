"""The validators that come with the USD library."""

from __future__ import annotations

from pathlib import Path


def errors_in(path: Path) -> list[str]:
    """One line for each error that a registered validator finds.

    The validators check stages, packages and prims, but not particle fields: the independent
    readers check the values. Warnings and remarks are ignored.
    """
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    stage = Usd.Stage.Open(str(path))
    stage.Reload()  # the library's cache may hold an older file of the same name
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    return [
        " ".join(error.GetErrorAsString().split())
        for error in found
        if error.GetType() == UsdValidation.ValidationErrorType.Error
    ]
