"""What happens at which step, after Kerbl et al. 2023.

The published schedule has 30,000 steps. Its events are scaled to the number of steps of the run,
which may change during the run. Unlike the published one, it never resets opacities, draws at half
the size in the first fifth and densifies only then, draws at several sizes after densification,
raises the learning rates of short runs, lets all of them decay, but less far, as the last steps are
averaged (`average`), replaces Adam after densification (`gauss_newton`), and bounds the number of
splats by a budget that rises linearly.
Steps count from 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.train.gauss_newton import DAMPING, INTERVAL, OPACITY_RATE, GaussNewton
from stages.train.optimiser import LearningRates

PUBLISHED_STEPS = 30_000
# x scene extent, at the first and at the last step. Published: 1.6e-6 at the last.
MEANS_LR, MEANS_LR_END = 1.6e-4, 6.4e-6
DENSIFICATION_END = 0.5  # share of the run in which the model is densified
# A run that is n times shorter than the published one, at most MOST_SHORTENED times, multiplies its
# learning rates by n to these powers (docs/experiments/densification.md).
MOST_SHORTENED = 20.0
RATES_POWER = 0.6  # all, but that of the means at the end
MEANS_END_POWER = 1.2
# Learning rates decay from this share of the run on, to this share of their value.
RATE_DECAY_FROM, RATE_DECAY_END = 0.6, 0.4
MIN_DENSIFY_INTERVAL = 50  # steps: fewer see too little of the scene
SCALES = (0.125, 0.25, 0.5, 1.0)  # of the images' sides
EIGHTH, QUARTER, HALF, FULL = range(len(SCALES))
# Share of the run that draws small images, which are cheap and smooth, and does not densify: many
# small splats fit every photograph wherever they are (docs/experiments/densification.md).
HALF_SIZE_END = 0.2
# `Schedule.since` of a run that starts from trained splats, without and with densification.
LAST_PART, DENSIFYING_PART = (0, RATE_DECAY_FROM), (0, HALF_SIZE_END)
# After densification, one of 20 steps each draws at an eighth, a quarter and half of the size, so
# that the splats are right in small images, too.
SMALLER_STEPS = {4: QUARTER, 9: HALF, 19: EIGHTH}
SMALLER_STEPS_PERIOD = 20


@dataclass(frozen=True)
class Schedule:
    """The schedule of a run.

    Args:
        steps: of the whole run.
        extent: of the scene, world units.
        sh_degree: of the final model.
        n_start: number of splats at the start.
        seed: of all random numbers.
        since: (step, share of the run done by then) of the last change of the plan.
    """

    steps: int
    extent: float
    sh_degree: int
    n_start: int
    seed: int
    since: tuple[int, float] = (0, 0.0)

    def _scaled(self, published_step: int) -> int:
        return max(1, round(published_step * self.steps / PUBLISHED_STEPS))

    def share(self, step: int) -> float:
        """Share of the run that is done before `step`, 0 to 1."""
        from_step, from_share = self.since
        return from_share + (1.0 - from_share) * (step - from_step) / (self.steps - from_step)

    def passes(self, step: int, parts: int) -> bool:
        """Whether one of `parts` equal parts of the run ends after `step` steps."""
        before, now = (int(parts * self.share(s) + 1e-9) for s in (step - 1, step))
        return step == self.steps or now > before

    def as_planned(self, steps: int, since: int, share: float) -> Schedule:
        """The same run with the plan of a checkpoint."""
        return replace(self, steps=steps, since=(since, share))

    def replanned(self, step: int, steps: int) -> Schedule:
        """The same run with `steps` steps in all, after `step` of them: the rest of the schedule is
        compressed or stretched."""
        return replace(self, steps=max(steps, step + 1), since=(step, self.share(step)))

    def densifying(self, step: int) -> bool:
        """Whether the model is still densified after `step` steps."""
        return self.share(step) < DENSIFICATION_END

    def raised(self, power: float) -> float:
        """Factor of a learning rate: how many times shorter this run is than the published one, to
        `power`."""
        times = min(MOST_SHORTENED, max(1.0, PUBLISHED_STEPS / self.steps))
        return float(times**power)

    def rates(self, step: int) -> LearningRates:
        """The learning rates of `step`: that of the means decays exponentially over the run, all
        others from RATE_DECAY_FROM on; that of opacities falls when densification ends."""
        first = MEANS_LR * self.raised(RATES_POWER)
        last = MEANS_LR_END * self.raised(MEANS_END_POWER)
        means = first * (last / first) ** self.share(step)
        decay = max(0.0, (self.share(step) - RATE_DECAY_FROM) / (1.0 - RATE_DECAY_FROM))
        factor = self.raised(RATES_POWER) * RATE_DECAY_END**decay
        rates = LearningRates().scaled(means * self.extent, factor, self.extent)
        if self.densifying(step):
            return rates
        return replace(rates, opacity_logits=OPACITY_RATE * rates.opacity_logits)

    def active_sh_degree(self, step: int) -> int:
        """One degree more every 1000 of 30,000 steps."""
        return min(self.sh_degree, int(PUBLISHED_STEPS / 1000 * self.share(step) + 1e-9))

    def densifies_after(self, step: int) -> bool:
        """Whether to densify once `step` is done."""
        interval = max(self._scaled(100), MIN_DENSIFY_INTERVAL)
        done = step + 1
        densifying = HALF_SIZE_END <= self.share(done) <= DENSIFICATION_END
        return densifying and done % interval == 0

    def budget(self, step: int, cap: int) -> int:
        """Largest number of splats after `step`. It rises linearly to the cap while the model is
        densified, so that early, noisy gradients do not use up what later, better ones need."""
        done = (self.share(step + 1) - HALF_SIZE_END) / (DENSIFICATION_END - HALF_SIZE_END)
        share = min(1.0, max(0.0, done))
        return max(self.n_start, round(self.n_start + (cap - self.n_start) * share))

    def level(self, step: int) -> int:
        """Index into SCALES."""
        if self.share(step) < HALF_SIZE_END:
            return HALF
        if self.densifying(step):
            return FULL
        return SMALLER_STEPS.get(step % SMALLER_STEPS_PERIOD, FULL)

    def weight(self, step: int) -> float:
        """Factor of the loss: the area of a pixel, in pixels of the full size (Barron et al. 2021,
        "Mip-NeRF"). 1 while the model is densified, by gradients at the size that is drawn."""
        return 1.0 if self.densifying(step) else SCALES[self.level(step)] ** -2

    def view(self, step: int, n_views: int) -> int:
        """Row of the training view of `step`: each of `n_views` once an epoch, in random order."""
        round_number, place = divmod(step, n_views)
        order = np.random.default_rng([self.seed, 1, round_number]).permutation(n_views)
        return int(order[place])

    def background(self, step: int) -> tuple[float, float, float]:
        """A random background: splats of one colour show before another."""
        red, green, blue = np.random.default_rng([self.seed, 3, step]).random(3)
        return float(red), float(green), float(blue)

    def gauss_newton(self, step: int, n_views: int) -> GaussNewton | None:
        """How `step` moves: None while the model is densified. The curvature is measured in each
        step until each of `n_views` training views has been drawn once, then in one of INTERVAL."""
        if self.densifying(step):
            return None
        damping = DAMPING / self.raised(RATES_POWER)
        since = self.share(step) - max(DENSIFICATION_END, self.share(0))
        measured = since / (self.share(step + 1) - self.share(step)) + 1e-6
        if step % INTERVAL and measured >= n_views:
            return GaussNewton(damping)
        key = int(np.random.default_rng([self.seed, 5, step]).integers(1 << 32))
        return GaussNewton(damping, key)

    def dropout_key(self, step: int) -> int:
        """32 random bits for `dropout.Dropout`."""
        return int(np.random.default_rng([self.seed, 4, step]).integers(1 << 32))
