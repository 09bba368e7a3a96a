"""What the network is trained on, without labels: Chamfer (alignment), occupancy (reconstruction), agreement (regions).

The modules know neither each other nor the model.
"""

from urrt_jax.losses.agreement import mutual_information, region_pairs
from urrt_jax.losses.chamfer import chamfer
from urrt_jax.losses.occupancy import occupancy_loss, shell_samples

__all__ = ["chamfer", "mutual_information", "occupancy_loss", "region_pairs", "shell_samples"]
