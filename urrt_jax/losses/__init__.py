"""What the network is trained on, without labels: Chamfer (alignment), occupancy (reconstruction), agreement (regions).

The modules know neither each other nor the model.
"""

from urrt_jax.losses.agreement import region_agreement, region_pairs
from urrt_jax.losses.chamfer import chamfer
from urrt_jax.losses.occupancy import occupancy_loss, shell_samples

__all__ = ["chamfer", "occupancy_loss", "region_agreement", "region_pairs", "shell_samples"]
