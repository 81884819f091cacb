"""UrdfError: why a robot description cannot be used."""


class UrdfError(ValueError):
    """The description is invalid or unsuitable; the message names the file, the link or joint, and what to do."""
