"""The base of the project's exceptions, which errors are a Ctrl-C, and errors in words."""

from __future__ import annotations


class EitskinError(Exception):
    """What eitskin raises where something cannot be used or done. The text is for the person who must act.

    Each also derives from the built-in exception in parentheses::

        EitskinError
        ├── Stale (RuntimeError)              no contact frame is new enough: stop, or fall back
        │   └── NotValid                      the newest frame is new and says that it must not be acted on
        ├── FrameError (ValueError)           a message is not a frame
        ├── FieldError                        a value is not what its field allows; a FrameError names frame and field
        │   └── BadArgument                   an argument of a command is not what the command takes
        ├── ControlError (RuntimeError)       a command was not carried out
        ├── TransportError (RuntimeError)     a socket or a key file cannot be used as configured
        ├── RuntimeDirError (RuntimeError)    the runtime folder cannot be used
        ├── AlreadyRunning (RuntimeError)     another service holds the runtime folder
        ├── LinkError (ValueError)            a message of the board link cannot be sent or does not fit
        ├── FileError                         models: a file cannot be read
        ├── BundleError                       a bundle cannot be used
        ├── Wrong                             what is wrong in a bundle; a BundleError names the bundle
        ├── GeometryError (ValueError)        a skin that cannot exist
        ├── PatternError (ValueError)         a drive pattern that cannot be measured or inverted
        ├── ScanSettingError (ValueError)     settings of a scan that no board can measure with
        ├── MeshError (RuntimeError)          an outline that cannot be meshed
        ├── MismatchError (ValueError)        a sheet that differs from its model in a way that cannot be
        ├── TooFewMeasured                    an untouched frame in which too little was measured to calibrate on
        ├── CalibrationFileError              what a calibration found cannot be read, kept or used
        ├── OtherScenes (ValueError)          training scenes of another skin, or of this one as it was
        ├── NoScenes (FileNotFoundError)      a folder has no training scenes
        ├── CheckpointError (ValueError)      a checkpoint of a training is not there, damaged, or of another training
        ├── OtherSkin (ValueError)            a bundle of another skin than the one that is trained
        ├── ArgumentError                     arguments of a program of models/ that cannot be meant
        ├── NoSuchNetwork (ValueError)        a file without the network that training is to start from
        ├── NoPart (ValueError)               a network that is not made of another's channels and blocks
        ├── NotRegistered (ValueError)        a folder to train for holds a bundle of no registered skin
        ├── TooLittle                         a bundle was trained too little to be written without --anyway
        ├── ParityError                       an exported network does not compute what PyTorch computes
        ├── SceneError (ValueError)           firmware_stub: a scene cannot be played
        ├── WorldError (ValueError)           no world of this name for a stub's skin
        ├── ConfigError                       services: skin.toml cannot be used
        ├── NoRoom                            the system allows too few descriptors, processes, or too little memory
        ├── Refused                           a stage does not carry out a command now
        ├── NoBaseline (ValueError)           frames, the latest scans or a saved state make no baseline
        ├── PortError                         the board's port cannot be opened, or is gone
        ├── RecordingError (ValueError)       a file is not a recording, or cannot be written
        ├── ReplayError                       a replay cannot begin or go on
        ├── InputError (ValueError)           arrays of a file are not what is needed
        ├── ImportRefused (ValueError)        a file cannot become a recording
        ├── RegistrationError (ValueError)    presses at known places do not register a skin
        ├── CalibrationError                  presses of known force make no force law
        ├── Doubtful                          a press whose force another sensor does not tell
        ├── MissingExtra                      the packages that a bridge needs are not installed
        ├── NotOurs                           a folder that must not be handed over
        ├── BridgeError                       bridges: a bridge cannot start
        ├── ReplayRefused                     the page does not record or replay now
        ├── NotUnderstood (ValueError)        what a page sent is no message
        └── CliError                          ends a command with one line and an exit code
    """


INCOMPLETE = 4
"""Exit code of a command that did its work, but not all of it is there: messages that were not recorded, or cannot be
read.
"""


def interrupted(error: BaseException) -> bool:
    """Whether Ctrl-C caused an error: a compiled module that is interrupted while it loads says `initialization
    failed`.
    """
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


def in_words(error: Exception) -> str:
    """The text of an error; of one of the system's the file and the reason, without its number."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
