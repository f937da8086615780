"""One run of a MEMS accelerometer in a chamber, of which everything is known.

A bias that bends, a scale factor that drifts with temperature, a second-order term, a kink below
−20 °C, an error that follows the rate of temperature and the difference of case and ambient, white
and slow noise, and a bias that is not the same after each switch-on.
"""

import numpy as np

import multipos as mp

STEP = 0.5  # [min] between rows
HOLD = 4.0  # [min] in each position: z up, down, level
RAMPS = [
    (60, 1),
    (60, 10),
    (-20, 1),
    (-45, 1 / 7),
    (-45, 15),
    (60, 1),
    (60, 10),
]  # °C; °C/min, soak


def ambient_temperature(cycles):
    """20 -> 60 -> -45 -> 60 °C, 1 °C/min, -1 °C per 7 min below -20 °C, soaks of 10, 15, 10 min."""
    parts, now = [], 20.0
    for target, rate in RAMPS + (cycles - 1) * RAMPS[2:]:
        minutes = rate if target == now else abs(target - now) / rate
        parts.append(np.linspace(now, target, round(minutes / STEP), endpoint=False))
        now = float(target)
    return np.concatenate(parts)


def run(seed, cycles=1):
    """Columns of one chamber run; `error` is the nominal conversion less the true force [g]."""
    rng = np.random.default_rng(seed)
    ambient = ambient_temperature(cycles)
    n = len(ambient)
    time = STEP * np.arange(n)
    device = np.empty(n)
    device[0] = ambient[0]
    for i in range(1, n):  # the case follows the chamber with a time constant of 6 min
        device[i] = device[i - 1] + (ambient[i] - device[i - 1]) * STEP / 6.0
    rate = np.gradient(device, STEP)
    force = np.array([1.0, -1.0, 0.0])[(time // HOLD).astype(int) % 3]
    t = device - 20.0
    bias = 0.020 + 0.6e-3 * t + 4e-6 * t**2 + 15e-6 * np.minimum(device + 20.0, 0.0) ** 2
    bias += 1.5e-3 * rate + 0.05e-3 * (ambient - device) + rng.normal(0.0, 0.3e-3)
    scale = 1.0 + 1.5e-4 * t + 8e-7 * t**2
    slow = np.empty(n)
    slow[0] = rng.normal(0.0, 0.4e-3)
    for i in range(1, n):
        slow[i] = 0.95 * slow[i - 1] + rng.normal(0.0, 0.4e-3 * np.sqrt(1 - 0.95**2))
    V = bias + scale * force + 2e-3 * force**2 + slow + rng.normal(0.0, 0.3e-3, n)
    return {
        "time": time,
        "V": V,
        "temperature": device + rng.normal(0.0, 0.02, n),
        "ambient": ambient + rng.normal(0.0, 0.02, n),
        "force": force,
        "error": V - force,
    }


if __name__ == "__main__":
    for name, seed in (("model.csv", 1), ("check.csv", 2)):
        mp.write_table(name, run(seed))
