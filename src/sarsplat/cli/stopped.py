"""How a signal ends a command."""


class Stopped(KeyboardInterrupt):
    """A signal that ended the work; the exit code says which."""

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(*([text] if text else []))
        self.number = number
