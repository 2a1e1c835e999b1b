"""The stub's sheet and analogue part and the stages, without board, line and clock: for tests that the link does not
affect.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.reliability.scenes import Matrix, SolvedSheet
from bench.reliability.session import Moment, moment
from bench.tracking.host import Felt
from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from firmware_stub.world import World
from protocol.frames import RawFrame
from services.pipeline import Pipeline

SCAN_NS = 43_600_000  # a full scan of the board
SNR_DB = 80.0


class DirectSkin:
    """One skin; each `feel` is one full scan of a world that stays as it is."""

    def __init__(self, sheet: SolvedSheet, pipeline: Pipeline, seed: int, snr_db: float = SNR_DB) -> None:
        self.sheet, self.pipeline, self.faults = sheet, pipeline, Faults()
        self.pattern = np.asarray(pipeline.pre.bundle.pattern, np.int64)
        self.analog = Analog(BoardNoise.of_db(snr_db), self.faults, np.random.default_rng([seed, 11]))
        self.scan = 0
        pipeline.reset()

    @property
    def now_s(self) -> float:
        return self.scan * SCAN_NS * 1e-9

    def feel(self, world: World, scans: int = 1) -> Iterator[Moment]:
        transfer = self.sheet.transfer(world)
        for _ in range(scans):
            yield self._scan(transfer, Felt(0.0, 0.0, world, world, {}))

    def rest(self, world: World, scans: int) -> list[Moment]:
        return list(self.feel(world, scans))

    def see(self, transfer: Matrix) -> list[Moment]:
        """One scan of an untouched sheet with these transfer impedances."""
        return [self._scan(transfer, None)]

    def _scan(self, transfer: Matrix, felt: Felt | None) -> Moment:
        config = self.pipeline.pre.config
        self.scan += 1
        z, status = self.analog.measure((transfer, transfer), self.pattern, config.setting, config.rtia_ohm, self.now_s)
        sample_ns = self.scan * SCAN_NS
        raw = RawFrame(
            skin="palm",
            scan=self.scan,
            stamps={"sample": sample_ns, "read": sample_ns + SCAN_NS // 2},
            source="board",
            valid=True,
            valid_for_s=0.13,
            z=z,
            status=status,
            board="bench",
        )
        result = self.pipeline.run(raw)
        return moment(self.now_s, self.now_s, felt, result.delta, result.contact)
