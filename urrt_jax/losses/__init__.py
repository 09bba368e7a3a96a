"""What the network is trained on, without labels: Chamfer (alignment) and occupancy (reconstruction).

The two modules know neither each other nor the model.
"""

from urrt_jax.losses.chamfer import chamfer
from urrt_jax.losses.occupancy import occupancy_loss, shell_samples

__all__ = ["chamfer", "occupancy_loss", "shell_samples"]
