"""The weights of `trust`, written by `make fit`: when the evidence changes, they must be fitted anew."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Law:
    """A linear law: a constant and one weight for each of `evidence.OF_PIXELS` and `evidence.OF_CELLS`."""

    constant: float
    pixels: tuple[float, ...]
    cells: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Laws:
    """Of the log-odds of an error beyond 1 px at full resolution, and of the log of sigma in the pair's own px."""

    wrong: Law
    sigma: Law


@dataclass(frozen=True, slots=True)
class Model:
    """Where one surface is seen, and between two."""

    alone: Laws
    between: Laws


FULL = Model(
    alone=Laws(
        wrong=Law(-2.6368, (0.0, 0.7208, 0.2108, 1.3086, 0.615),
                  (0.5488, -2.9514, 0.9397, 0.4555, 3.1809, 0.0046, -3.2589)),
        sigma=Law(0.5627, (0.0, 0.2541, -0.0023, 0.7642, 0.0327),
                  (0.7585, -4.1414, 2.8013, 0.0427, 2.3176, 0.0008, -0.5325)),
    ),
    between=Laws(
        wrong=Law(-2.781, (0.2996, 0.2496, 0.1229, 0.7523, 0.5213),
                  (0.2434, -0.9211, 0.0615, 0.2017, 2.0278, 0.0069, -1.2167)),
        sigma=Law(0.0504, (0.1133, 0.1028, 0.1212, 0.7391, 0.2483),
                  (0.539, -2.2916, 0.7942, 0.0796, 1.3363, -0.0124, -0.744)),
    ),
)
HALF = Model(
    alone=Laws(
        wrong=Law(-2.1672, (0.0, 0.8586, 0.8325, 1.9256, 0.6397),
                  (0.7946, -3.7822, 0.9209, 0.4924, 3.2067, -0.3645, -2.7363)),
        sigma=Law(-0.516, (0.0, 0.1568, 0.125, 1.4371, 0.0602),
                  (0.4518, -3.2576, 3.9424, 0.0758, 0.9812, 0.0742, -0.5608)),
    ),
    between=Laws(
        wrong=Law(-1.4114, (0.3068, 0.0402, 0.1963, 0.6735, 0.6432),
                  (0.2522, -1.1584, 0.0655, 0.2252, 1.1065, 0.0685, -1.6105)),
        sigma=Law(-0.1277, (0.1065, 0.0198, 0.1563, 0.6837, 0.2247),
                  (0.4096, -1.9705, 0.4977, 0.157, 1.169, 0.0029, -1.0301)),
    ),
)
