"""What is not to be believed: electrodes and multiplexers at fault, changes that no touch makes, images that do not
explain what was measured.
"""
