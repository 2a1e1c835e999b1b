"""What a person can do about each reason why a frame is not to be acted on."""

ADVICE = {
    "stale_baseline": "Take everything off the skin and tare it.",
    "touched_at_start": "Take everything off the skin. If nothing touches it, tare it.",
    "saturated": "Look for a short or a loose wire at the board; a lighter touch may do, too.",
    "fifo": "Wait: the next scans should be whole. If it goes on, power-cycle the board.",
    "electrode_open": "Look at the wire of the electrode marked open, and press it on.",
    "electrode_short": "Part the wires of the electrodes marked short.",
    "electrode_swapped": "Exchange the wires of the electrodes marked swapped.",
    "electrode_drift": "Press on the electrode marked drifting, then tare the skin.",
    "multiplexer": "Look at the board's address lines; power-cycle the board.",
    "degraded": "Mend the electrodes that are marked.",
    "gap": "Wait: scans are missing. If it goes on, look at the cable and the load of this computer.",
    "low_snr": "Look for a source of electrical noise near the skin; shorten its cable.",
    "out_of_distribution": "Take everything off the skin and tare it. If it comes back, look at the electrodes.",
    "coarse": "Wait for the full scan that follows at once.",
    "changing": "Hold still for one scan to know the place exactly.",
    "extrapolated": "Press less hard, or calibrate for larger forces.",
    "late": "Look at the line to the board and the load of this computer.",
    "clock": "Wait: the board's clock is being learned. If it goes on, look at the cable.",
    "gain": "Take everything off the skin; if it goes on, tare it, and look at the board's supply.",
    "frozen": "Power-cycle the board.",
    "uncalibrated_force": "Calibrate the force: `skin calibrate force`.",
    "replay": "Nothing: this is a recording.",
    "separate": "Nothing: these scans come from a file.",
    "non_finite": "Power-cycle the board; if it goes on, report it.",
}
"""A sentence for each reason of protocol.frame_types.REASONS; a test keeps the two together. To tare is `skin tare`, or
Tare on the page.
"""
