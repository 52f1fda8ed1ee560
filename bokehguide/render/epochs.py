"""Epochs: ranges of steps, 1, 2, 3 to 4, 5 to 8, 9 to 16, …, whose lengths are powers of two.

Within an epoch, lens densities do not change and lens points are stratified. Random numbers of different epochs are independent.
"""


def epoch_number(step: int) -> int:
    """Number of the epoch of a step, from 0."""
    return (step - 1).bit_length()


def epoch_of(step: int) -> int:
    """First step of the epoch of a step: 1, 2, 3, 5, 9, 17, …"""
    return 1 + (1 << epoch_number(step) >> 1)


def starts_epoch(step: int) -> bool:
    """Whether an epoch starts at a step."""
    return epoch_of(step) == step
