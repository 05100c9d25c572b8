"""What happens at which step. The reference recipe is written for 30,000 steps; all its events
move with the number of steps that a preset can afford, and with what becomes of it on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

RECIPE_STEPS = 30_000
MEANS_LR = 1.6e-4  # x scene extent
MEANS_LR_END = 0.01  # of the first
DENSIFICATION_END = 0.5  # share of the run in which the model grows
BOOST_POWER, BOOST_MAX = 0.6, 6.0
RATE_DECAY_FROM, RATE_DECAY_END = 0.6, 0.1  # share of the run; share of the rate at its end
MIN_DENSIFY_INTERVAL = 50  # steps: fewer do not see enough of the scene to judge a splat by
# (share of the run, scale of the picture): coarse pictures first, they are cheap and smooth
RESOLUTIONS = ((0.2, 0.5), (1.0, 1.0))


@dataclass(frozen=True)
class Schedule:
    """steps: of the whole run. extent: of the scene, world units. sh_degree: reached at the end.
    n_start: splats at the start. since: (step, share of the run that was done by then) of the last
    change of plan."""

    steps: int
    extent: float
    sh_degree: int
    n_start: int
    seed: int
    since: tuple[int, float] = (0, 0.0)

    def _scaled(self, recipe_step: int) -> int:
        return max(1, round(recipe_step * self.steps / RECIPE_STEPS))

    def share(self, step: int) -> float:
        """How much of the run is done before `step`, 0 to 1."""
        from_step, from_share = self.since
        if from_step == 0:
            return step / self.steps
        return from_share + (1.0 - from_share) * (step - from_step) / (self.steps - from_step)

    def passes(self, step: int, parts: int) -> bool:
        """Whether `step` steps end one of `parts` equal parts of the run."""
        before, now = (int(parts * self.share(s) + 1e-9) for s in (step - 1, step))
        return step == self.steps or now > before

    def as_planned(self, steps: int, since: int, share: float) -> Schedule:
        """The same run under a plan that was made before."""
        return replace(self, steps=steps, since=(since, share))

    def replanned(self, step: int, steps: int) -> Schedule:
        """The same run, of which `step` steps are done, with `steps` in all: what is left of its
        course is gone through faster, or more slowly."""
        return replace(self, steps=max(steps, step + 1), since=(step, self.share(step)))

    def without_densification(self, step: int) -> Schedule:
        """The same run if densification ends after `step` steps. The total becomes what it would be
        if that had been planned."""
        if self.share(step) >= DENSIFICATION_END:
            return self
        steps = max(step + 1, round(step / DENSIFICATION_END))
        return replace(self, steps=steps, since=(step, DENSIFICATION_END))

    def densifying(self, step: int) -> bool:
        """Whether the model is still densified after `step` steps."""
        return self.share(step) < DENSIFICATION_END

    @property
    def boost(self) -> float:
        """A short run takes longer strides: (30,000 / steps)^0.6, at most 6."""
        return float(min(BOOST_MAX, max(1.0, (RECIPE_STEPS / self.steps) ** BOOST_POWER)))

    def means_lr(self, step: int) -> float:
        """Exponential decay to 1 %."""
        decay = MEANS_LR_END ** self.share(step)
        return float(MEANS_LR * self.extent * self.boost * decay)

    def rate_factor(self, step: int) -> float:
        """What all other rates are multiplied by: the boost, and a decay at the end."""
        decay = max(0.0, (self.share(step) - RATE_DECAY_FROM) / (1.0 - RATE_DECAY_FROM))
        return float(self.boost * RATE_DECAY_END**decay)

    def active_sh_degree(self, step: int) -> int:
        """One degree more every 1000 steps of the recipe."""
        return min(self.sh_degree, int(RECIPE_STEPS / 1000 * self.share(step) + 1e-9))

    def densifies_after(self, step: int) -> bool:
        """Whether to densify once `step` is done."""
        interval = max(self._scaled(100), MIN_DENSIFY_INTERVAL)
        done = step + 1
        starts, ends = 500 / RECIPE_STEPS, DENSIFICATION_END
        return starts <= self.share(done) <= ends and done % interval == 0

    def budget(self, step: int, cap: int) -> int:
        """Splats allowed after `step`: grows evenly to the cap, so that early, noisy gradients do
        not spend what later, better ones will want."""
        share = min(1.0, self.share(step + 1) / DENSIFICATION_END)
        return max(self.n_start, round(self.n_start + (cap - self.n_start) * share))

    def removes_giants(self, step: int) -> bool:
        return self.share(step) >= 3000 / RECIPE_STEPS

    def level(self, step: int) -> int:
        """Index into RESOLUTIONS."""
        share = self.share(step)
        return sum(share >= end for end, _ in RESOLUTIONS[:-1])

    def view(self, step: int, n_views: int) -> int:
        """Every one of `n_views` photographs once in each round, in a new order each round."""
        round_number, place = divmod(step, n_views)
        order = np.random.default_rng([self.seed, 1, round_number]).permutation(n_views)
        return int(order[place])

    def background(self, step: int) -> tuple[float, float, float]:
        """Any colour, behind what was cut out: what hides in one shows before the next."""
        red, green, blue = np.random.default_rng([self.seed, 3, step]).random(3)
        return float(red), float(green), float(blue)

    def dropout_key(self, step: int) -> int:
        """32 random bits, for numbers that a device makes by itself."""
        return int(np.random.default_rng([self.seed, 4, step]).integers(1 << 32))

    def rng(self, step: int) -> np.random.Generator:
        """Random numbers of one step, whatever happened before it."""
        return np.random.default_rng([self.seed, 2, step])
