"""The AD5940's result words and what an impedance is computed from.

A FIFO word is ECC[31:25], sequence number[24:23], channel id[22:18], data[17:0]; DFT results are 18-bit two's
complement, and the imaginary part comes with its sign inverted (AD5940 data sheet, data FIFO and DFT).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DATA_BITS = 18
DATA_MAX = 2 ** (DATA_BITS - 1) - 1
DATA_MIN = -(2 ** (DATA_BITS - 1))
LEAST_RTIA_OHM, MOST_RTIA_OHM = 100.0, 1e6
"""Gain resistors of the current measurement that a board may have, in the chip or beside it."""
CHANNEL_DFT = 0b11111
"""Channel id of a DFT result."""


def encode_fifo(
    data: NDArray[np.integer], seq: int = 0, channel: int = CHANNEL_DFT, ecc: int = 0
) -> NDArray[np.uint32]:
    """FIFO words of signed 18-bit values, uint32, shape as given. Values beyond 18 bits are clipped, as the
    accumulator does.
    """
    clipped = np.clip(np.asarray(data, np.int64), DATA_MIN, DATA_MAX) & (2**DATA_BITS - 1)
    head = (ecc & 0x7F) << 25 | (seq & 3) << 23 | (channel & 31) << 18
    return np.asarray(clipped | head, np.uint32)


def decode_fifo(words: NDArray[np.uint32]) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.uint8]]:
    """(data, seq, channel) of FIFO words: signed 18-bit values, 2-bit sequence number, 5-bit channel id; shape as
    given.
    """
    words = np.asarray(words, np.uint32)
    data = (words & (2**DATA_BITS - 1)).astype(np.int32)
    data -= (data >> (DATA_BITS - 1)) << DATA_BITS
    return data, (words >> 23 & 3).astype(np.uint8), (words >> 18 & 31).astype(np.uint8)


def dft_pair(value: NDArray[np.complexfloating]) -> NDArray[np.int32]:
    """Real and imaginary DFT results (..., 2) as the chip gives them: rounded, clipped to 18 bits, imaginary sign
    inverted.
    """
    pair = np.stack([value.real, -value.imag], axis=-1)
    return np.clip(np.rint(pair), DATA_MIN, DATA_MAX).astype(np.int32)


def impedance(voltage: NDArray[np.int32], current: NDArray[np.int32], rtia_ohm: float) -> NDArray[np.complex64]:
    """Z = V / I * RTIA [ohm] from DFT pairs (..., 2) of voltage and current; non-finite where the current is 0."""
    v = voltage[..., 0] - 1j * voltage[..., 1]
    i = current[..., 0] - 1j * current[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(v / i * rtia_ohm, np.complex64)
