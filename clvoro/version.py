"""The version of clvoro, for modules of all packages."""

__version__ = "0.2.0"
