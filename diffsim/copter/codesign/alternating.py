from dataclasses import dataclass


@dataclass
class AlternatingOptions:
    x: int = 0


def alternating(*a):
    raise NotImplementedError
