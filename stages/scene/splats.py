"""Gaussian splats as arrays, and their quantised form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera
from stages.scene.capture import RefinedCameras
from stages.scene.draw_settings import DrawSettings
from stages.scene.place import EarthPlace

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant spherical harmonic
ROW_FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")
"""The fields of `Splats` that have a row for each splat."""


@dataclass(frozen=True, repr=False)
class Splats:
    """N splats. Arrays are float32, or float64 where a test wants more.

    means [N, 3]: centres, in the world less `origin`.
    quaternions [N, 4]: w, x, y, z; not necessarily unit.
    log_scales [N, 3]: natural logarithm of the standard deviations along the splat's own axes.
    opacity_logits [N]: opacity = 1 / (1 + exp(-logit)).
    sh [N, (L + 1)^2, 3]: spherical harmonics, DC first, then m = -l..l of each degree; RGB last.
        colour = max(0, 0.5 + sum of basis x coefficient), in the photographs' own sRGB values.
    sh_degrees [N] uint8: the degree that each splat uses; coefficients above it are zero.
    origin [3] float64: what to add to `means` to be back in the capture's coordinates. float32
        positions near zero keep their precision however far away the capture lies.
    draw_settings: how they are drawn and evaluated.
    place: where these coordinates are on the earth; None if that is unknown.
    first_camera: where a viewer begins, in the frame of `means`; None if that is unknown.
    """

    means: NDArray[np.floating]
    quaternions: NDArray[np.floating]
    log_scales: NDArray[np.floating]
    opacity_logits: NDArray[np.floating]
    sh: NDArray[np.floating]
    sh_degrees: NDArray[np.uint8]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    draw_settings: DrawSettings = field(default_factory=DrawSettings)
    place: EarthPlace | None = None
    first_camera: Camera | None = None

    def __post_init__(self) -> None:
        n = len(self.means)
        wanted = {
            "means": (n, 3),
            "quaternions": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh": (n, self.sh.shape[1] if self.sh.ndim == 3 else -1, 3),
            "sh_degrees": (n,),
            "origin": (3,),
        }
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, wanted {shape}")
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"sh has {self.sh.shape[1]} coefficients, wanted 1, 4, 9 or 16")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Splats({len(self):,}, SH degree {self.sh_degree})"

    def __getitem__(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> Splats:
        return self.take(index)

    @property
    def arrays(self) -> tuple[NDArray[np.floating], ...]:
        """The five parameter arrays in the order of the fields, as a rasteriser takes them."""
        return (self.means, self.quaternions, self.log_scales, self.opacity_logits, self.sh)

    @property
    def sh_degree(self) -> int:
        """The SH degree of the coefficients in `sh`."""
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]

    @property
    def opacities(self) -> NDArray[np.floating]:
        """[N] in [0, 1]."""
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-self.opacity_logits)))

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> Splats:
        """The rows named by an index, a mask or a slice."""
        return replace(self, **{name: getattr(self, name)[index] for name in ROW_FIELDS})

    def local(self, camera: Camera) -> Camera:
        """A camera of the capture's coordinates, in the frame of `means`; shifted in float64, so
        that a capture 6000 km from its origin renders as one beside it."""
        shift = np.eye(4)
        shift[:3, 3] = self.origin
        return camera.moved(shift)

    def with_antialias(self, antialias: bool) -> Splats:
        """The same values, to be drawn with or without opacity compensation."""
        return replace(self, draw_settings=replace(self.draw_settings, antialias=antialias))

    def with_sh_degree(self, degree: int) -> Splats:
        """With coefficients of higher degrees dropped, or zero coefficients added."""
        wanted = (degree + 1) ** 2
        have = self.sh.shape[1]
        if wanted <= have:
            sh = self.sh[:, :wanted]
        else:
            sh = np.concatenate(
                [self.sh, np.zeros((len(self), wanted - have, 3), self.sh.dtype)], axis=1
            )
        return replace(self, sh=sh, sh_degrees=np.minimum(self.sh_degrees, degree))


@dataclass(frozen=True)
class TrainedSplats:
    """The result of training.

    Args:
        splats: what was trained.
        dropout: whether some were dropped from each of the last steps (`train.dropout`).
        cameras: where training has refined them; None where it has not.
        contradicted: whether they are wrong because photographs contradict each other.
        masks: of training views that show what moved, which training ignored; by name.
        steps: how many made them; 0 where another program or an older version did.
    """

    splats: Splats
    dropout: bool = False
    cameras: RefinedCameras | None = None
    contradicted: bool = False
    masks: Mapping[str, Path] = field(default_factory=dict)
    steps: int = 0


@dataclass(frozen=True)
class SizeLimit:
    """The largest size requested of a file. format: its name. max_bytes: what it may take."""

    format: str
    max_bytes: float


@dataclass(frozen=True)
class PrunedSplats:
    """The result of pruning. limit: that it was pruned for; None for no limit of a file's size."""

    splats: Splats
    limit: SizeLimit | None = None


@dataclass(frozen=True)
class QuantisedSplats:
    """Splats as decided for export: what was kept, and at which precision.

    Args:
        splats: the values to export, SH already cut to the degree decided for each splat.
        sog_bits: bit depth by attribute of a .sog; None where no .sog was requested.
        flat_dc: [N, 3] DC coefficients for formats without view-dependent colour; None where those
            of the splats serve.
        finetuned: for each format that rounds values, the splats that its file should hold,
            fine-tuned to that rounding.
        plain: the splats for formats that are drawn without opacity compensation; None where
            `splats` are drawn without it, or no such format was requested.
        drawing: which formats these are, see `formats.format_table.Format.holds_antialiased`.
        limit: that the splats were pruned for; None for no limit of a file's size.
    """

    splats: Splats
    sog_bits: Mapping[str, int] | None = None
    flat_dc: NDArray[np.floating] | None = None
    finetuned: Mapping[str, Splats] = field(default_factory=dict)
    plain: Splats | None = None
    drawing: str = "auto"
    limit: SizeLimit | None = None


def parameters_per_splat(sh_degrees: NDArray[np.integer]) -> NDArray[np.int64]:
    """[N] number of parameters of a splat of each SH degree: mean, rotation, scales, opacity, and
    three for each SH coefficient."""
    return np.asarray(3 + 4 + 3 + 1 + 3 * (sh_degrees.astype(np.int64) + 1) ** 2)


def rgb_to_dc(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """DC coefficients whose colour is `rgb` (0..1)."""
    return (rgb - 0.5) / SH_C0


def dc_to_rgb(dc: NDArray[np.floating]) -> NDArray[np.floating]:
    """View-independent colour of DC coefficients, not clamped above."""
    return np.asarray(np.maximum(0.0, 0.5 + SH_C0 * dc))


def logit(p: NDArray[np.floating] | float) -> NDArray[np.floating]:
    """Inverse of the logistic function; p strictly between 0 and 1."""
    p = np.asarray(p)
    return np.log(p / (1.0 - p))
