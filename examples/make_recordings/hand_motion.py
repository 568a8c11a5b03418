"""How a person's hand moves: minimum-jerk strokes with pauses, slow wandering, curved reaches; sampled at 100 Hz."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

RATE = 100.0  # [Hz]
RAMP = 0.45  # time to get going, and to come to rest [s]


def minimum_jerk(s: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Way between 0 and 1 at share s of the time; Flash and Hogan (1985): s^3 (10 - 15 s + 6 s^2)."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def samples(duration: float) -> int:
    """Number of sampling intervals in a time [s], at least two."""
    return max(round(duration * RATE), 2)


def strokes(
    points: Float[np.ndarray, "m k"], durations: Float[np.ndarray, " m"], pauses: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "T k"]:
    """From the origin to one point after another, a pause [s] after each stroke [s]; begins with the origin."""
    here, parts = np.zeros(points.shape[1]), [np.zeros((1, points.shape[1]))]
    for point, duration, pause in zip(points, durations, pauses, strict=True):
        n = samples(duration)
        parts.append(here + np.outer(minimum_jerk(np.arange(1, n + 1) / n), point - here))
        parts.append(np.tile(point, (round(pause * RATE), 1)))
        here = point
    return np.concatenate(parts)


def slow_curve(
    n: int, size: Float[np.ndarray, " k"], band: tuple[float, float], rng: np.random.Generator, waves: int = 4
) -> Float[np.ndarray, "T k"]:
    """A smooth curve from the origin, n intervals long, at rest at both ends.

    A few sines a channel with frequencies in a band [Hz] and standard deviation `size`, run through with a speed that
    ramps up and down.
    """
    shape = (waves, len(size))
    amplitude = rng.uniform(0.5, 1.5, shape)
    amplitude *= size / np.sqrt(0.5 * np.sum(amplitude**2, axis=0))
    frequency = 2.0 * np.pi * rng.uniform(*band, shape)
    phase = rng.uniform(0.0, 2.0 * np.pi, shape)
    t = np.arange(n + 1) / RATE
    ramp = min(RAMP, 0.4 * t[-1])
    speed = minimum_jerk(t / ramp) * minimum_jerk((t[-1] - t) / ramp)
    clock = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / RATE
    wave = np.sum(amplitude * np.sin(frequency * clock[:, None, None] + phase), axis=1)
    return wave - wave[0]


def reach(
    start: Float[np.ndarray, " n"],
    end: Float[np.ndarray, " n"],
    duration: float,
    bend: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T n"]:
    """A curved reach between two postures [rad]: every joint takes its own detour of about `bend` [rad]."""
    n = samples(duration)
    s = minimum_jerk(np.arange(n + 1) / n)
    early, late = 16.0 * (s * (1.0 - s)) ** 2, 48.0 * (s * (1.0 - s)) ** 2 * (s - 0.5)
    detour = np.outer(early, rng.normal(0.0, bend, len(start))) + np.outer(late, rng.normal(0.0, bend, len(start)))
    return start + np.outer(s, end - start) + detour


def rest(posture: Float[np.ndarray, " n"], duration: float) -> Float[np.ndarray, "T n"]:
    """The arm left alone for a time [s]."""
    return np.tile(posture, (samples(duration) + 1, 1))
