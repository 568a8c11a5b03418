"""A person's hand: smooth out-and-in motion with variation, and slow pushes against the arm's joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True)
class SlowNoise:
    """Band-limited noise: a few sines of random frequency and phase in each channel, zero at t = 0.

    Attributes:
        amplitude: shape (n, k), in the channel's unit.
        frequency: shape (n, k) [rad/s].
        phase: shape (n, k) [rad].
    """

    amplitude: Float[np.ndarray, "n k"]
    frequency: Float[np.ndarray, "n k"]
    phase: Float[np.ndarray, "n k"]

    def __call__(self, t: float) -> Float[np.ndarray, " n"]:
        """The noise at time t [s]; it fades in over 0.3 s."""
        fade = min(t / 0.3, 1.0)
        return fade * np.sum(self.amplitude * np.sin(self.frequency * t + self.phase), axis=1)


def slow_noise(
    size: Float[np.ndarray, " n"], lowest: float, highest: float, rng: np.random.Generator, waves: int = 4
) -> SlowNoise:
    """Noise of standard deviation `size` a channel between two frequencies [Hz]."""
    shape = (len(size), waves)
    amplitude = rng.uniform(0.5, 1.5, shape)
    amplitude *= (np.asarray(size) / np.sqrt(0.5 * np.sum(amplitude**2, axis=1)))[:, None]
    return SlowNoise(amplitude, 2 * np.pi * rng.uniform(lowest, highest, shape), rng.uniform(0, 2 * np.pi, shape))


@final
@dataclass(frozen=True)
class OutAndIn:
    """How far the operator has the handle in mind at each moment: out, a short rest, back in.

    Attributes:
        out: Time to pull out [s].
        rest: Time at the far end [s].
        back: Time to push in [s].
        reach: Way to the far end [m or rad].
        left: Way that is left at the end of the push [m or rad].
    """

    out: float
    rest: float
    back: float
    reach: float
    left: float

    @property
    def duration(self) -> float:
        """Time of the whole motion [s]."""
        return self.out + self.rest + self.back

    def __call__(self, t: float) -> float:
        """Way at time t [s]: two minimum-jerk strokes."""
        if t < self.out + self.rest:
            return self.reach * _minimum_jerk(t / self.out)
        return self.reach + (self.left - self.reach) * _minimum_jerk((t - self.out - self.rest) / self.back)


def out_and_in(reach: tuple[float, float], rng: np.random.Generator) -> OutAndIn:
    """An out-and-in motion with human-like variation of speed, rest and reach."""
    far = rng.uniform(*reach)
    return OutAndIn(
        rng.uniform(1.4, 1.8), rng.uniform(0.0, 0.2), rng.uniform(1.4, 1.8), far, far * rng.uniform(0.0, 0.25)
    )


def _minimum_jerk(s: float) -> float:
    s = min(max(s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
