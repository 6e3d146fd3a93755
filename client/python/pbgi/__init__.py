"""Client of the pbgi shading server: jobs, scenes, and live shading with NumPy arrays.

Start at `Client`. Failures are `Error`.
"""

from .client import Client, Error, Shaded

__all__ = ["Client", "Error", "Shaded"]
