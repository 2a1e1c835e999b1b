"""What the page is told."""

from __future__ import annotations

from dataclasses import dataclass

from bridges.process import BridgeError, Handed


@dataclass(frozen=True)
class PageSettings:
    """`skins`: which to show. `host`, `port`: where to listen, or at the first free port from there on. `names`: host
    names beside those of the loopback under which browsers may ask for the page. `recordings`: folder of what the
    page's button records; "": no button. `metrics`: whether /metrics is there, for Prometheus.
    """

    skins: tuple[str, ...]
    host: str
    port: int
    names: tuple[str, ...]
    recordings: str
    metrics: bool = False

    @staticmethod
    def of(handed: Handed) -> PageSettings:
        """From a bridge's settings. Raises BridgeError."""
        options = handed.options
        try:
            return PageSettings(
                tuple(handed.skins),
                str(options["host"]),
                int(options["port"]),
                tuple(map(str, options["names"])),
                str(options["recordings"]),
                bool(options.get("metrics")),
            )
        except (KeyError, TypeError, ValueError) as bad:
            raise BridgeError(
                f"the page's options: found {options!r:.200} ({type(bad).__name__}: {bad}), expected host, port, "
                "names, recordings"
            ) from None
