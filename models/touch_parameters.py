"""What a touch's parameters are (numpy only): theta = (x, y, log radius, logit drop, rotation, log aspect), as many as
its kind needs.
"""

from __future__ import annotations

import numpy as np

from models.shapes import Array, Shape

FREE = {"circle": 4, "hertz": 4, "triangle": 5, "rectangle": 6, "square": 5, "L": 5}  # parameters of each kind
LOG_RADIUS = 2  # its place in theta
PERIOD = {"triangle": 2 * np.pi / 3, "rectangle": np.pi, "square": np.pi / 2, "L": 2 * np.pi}

# Prior of theta, normal: the ranges of models.scenes.TRAINING, wider. Rotation: any of the kind's period.
MEAN = np.array([0.0, 0.0, np.log(0.27), -0.9, 0.0, np.log(1.9)])
SD = np.array([0.6, 0.6, 0.45, 0.9, 1.0, 0.25])
LOW = np.array([-1.0, -1.0, np.log(0.05), -5.0, -np.inf, 0.0])
HIGH = np.array([1.0, 1.0, np.log(0.95), 3.5, np.inf, np.log(4.0)])


def shape_of(kind: str, theta: Array) -> Shape:
    turn = float(theta[4]) if len(theta) > 4 else 0.0
    aspect = float(np.exp(theta[5])) if len(theta) > 5 else 1.0
    drop = float(1 / (1 + np.exp(-theta[3])))
    return Shape(kind, float(theta[0]), float(theta[1]), float(np.exp(theta[2])), drop, turn, aspect)


def turn_between(kind: str, theta: Array, other: Array) -> float:
    """The rotation from one touch of a kind to another: within half a period of none."""
    period = PERIOD[kind]
    return float((other[4] - theta[4] + period / 2) % period - period / 2)
