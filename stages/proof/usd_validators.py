"""What the validators that come with the USD library say about a file."""

from __future__ import annotations

from pathlib import Path


def errors_in(path: Path) -> list[str]:
    """One line for each error that any of its registered validators finds.

    They know stages, packages and prims, but nothing of particle fields: values are for the
    readers to check. Warnings and remarks are left out.
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
