"""The validators that come with the USD library."""

from __future__ import annotations

from pathlib import Path

from stages.base.usd_path import accepted_path


def usd_errors(path: Path) -> list[str]:
    """One line for each error that a registered validator finds.

    The validators check stages, packages and prims, but not particle fields: the independent
    readers check the values. Warnings and remarks are ignored.
    """
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    with accepted_path(path) as name:
        stage = Usd.Stage.Open(name)
        stage.Reload()  # the library's cache may hold an older file of the same name
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [
        " ".join(error.GetErrorAsString().split())
        for error in errors
        if error.GetType() == UsdValidation.ValidationErrorType.Error
    ]
