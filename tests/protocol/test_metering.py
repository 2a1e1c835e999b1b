"""Rates and quantiles of a process's status: known answers."""

import time

import pytest

from protocol.metering import Meter


def test_rates_are_of_the_time_since_the_last_measurement() -> None:
    meter, began = Meter(), time.monotonic()
    meter.sent["contact"] += 200
    meter.measure(began + 100.0)
    assert meter.rates["contact"] == pytest.approx(2.0, rel=0.01)
    meter.measure(began + 100.1)  # too soon
    assert meter.rates["contact"] == pytest.approx(2.0, rel=0.01)
    meter.measure(began + 200.0)
    assert meter.rates["contact"] == 0.0


def test_quantiles_are_milliseconds_and_none_where_no_age_is_known() -> None:
    meter = Meter()
    assert meter.quantiles() == {}
    for k in range(100):
        meter.handled(None, k * 1_000_000)
    assert meter.quantiles() == {"work_p50": 50.0, "work_p99": 99.0}
    meter.handled(7_000_000, 0)
    assert meter.quantiles()["p50"] == meter.quantiles()["p99"] == 7.0
