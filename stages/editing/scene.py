"""What operations edit: splats, and the cameras and pictures of the run that they come from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.contribution import Contributions, measure_contributions
from stages.evaluate.evaluation import EvaluationView, mean_psnr_db
from stages.formats.values import select_rows
from stages.raster.backends import AUTO
from stages.raster.similarity import Similarity
from stages.scene import Camera, Splats, View

_COMPARABLE = 0.9  # of the pictures: with less, the PSNR measures what was cut away


@dataclass(frozen=True)
class EditedScene:
    """Splats and what is known about them.

    Attributes:
        splats: as they are after the operations so far.
        units: "metres" or "arbitrary".
        training_views: views that the splats were trained on; empty where they are not known.
        held_out_views: views for the PSNR; the training views where none are held out.
        views: the cameras of the capture.
        placement: where the operations have moved the scene. The views above are those of the
            capture; they see the splats after this transform.
        backend: the rasteriser.
        kept_share: how much of the held-out pictures the splats that were kept made up, by their
            blend weights.
    """

    splats: Splats
    units: str = "arbitrary"
    training_views: Sequence[EvaluationView] = ()
    held_out_views: Sequence[EvaluationView] = ()
    views: tuple[View, ...] = ()
    placement: Similarity = field(default_factory=Similarity)
    backend: str = AUTO
    kept_share: float = 1.0

    def reduced_to(self, found: NDArray[np.bool_]) -> EditedScene:
        """The same scene with the splats where `found` [N] is true."""
        share = self.kept_share
        if len(self.held_out_views) and not found.all():
            views = _placed(self.held_out_views, self.placement)
            weights = measure_contributions(self.splats, views, self.backend).weight
            share *= float(weights[found].sum() / max(weights.sum(), 1e-30))
        return replace(self, splats=select_rows(self.splats, found), kept_share=share)

    def with_splats(self, splats: Splats) -> EditedScene:
        """The same scene with other splats."""
        return replace(self, splats=splats)

    def transformed(self, transform: Similarity) -> EditedScene:
        """The scene after `transform`. Its units are arbitrary if the scale is not 1."""
        splats = transform.apply_to_splats(self.splats)
        # The cameras do not move by what `apply_to_splats` put into the origin.
        shift = splats.origin - transform.scale * transform.rotation @ self.splats.origin
        placement = replace(transform, offset=transform.offset - shift).after(self.placement)
        units = self.units if transform.scale == 1 else "arbitrary"
        return replace(self, splats=splats, placement=placement, units=units)

    @property
    def moved(self) -> bool:
        """Whether the splats lie elsewhere than the capture's cameras see them."""
        return not np.array_equal(self.placement.inverse_matrix, np.eye(4))

    def psnr_db(self) -> float | None:
        """Mean PSNR of the held-out views; None where there are none, and where so little of their
        pictures was kept that it says nothing."""
        if not len(self.held_out_views) or self.kept_share < _COMPARABLE:
            return None
        views = _placed(self.held_out_views, self.placement)
        return mean_psnr_db(self.splats, views, self.backend)

    def placed_views(self) -> tuple[View, ...]:
        """The cameras of the capture in the edited scene."""
        place = self.placement.apply_to_camera
        return tuple(replace(view, camera=place(view.camera)) for view in self.views)

    def training_cameras(self) -> list[Camera]:
        """The cameras of the training views in the edited scene."""
        return [self.placement.apply_to_camera(view.camera) for view in self.training_views]

    def contributions(self) -> Contributions:
        """The contribution of each splat to the training views. There must be training views."""
        views = _placed(self.training_views, self.placement)
        return measure_contributions(self.splats, views, self.backend)


def _placed(views: Iterable[EvaluationView], placement: Similarity) -> Iterator[EvaluationView]:
    """The views with transformed cameras; each is read when it is used."""
    return (replace(view, camera=placement.apply_to_camera(view.camera)) for view in views)
