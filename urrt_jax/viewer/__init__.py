"""Pictures of a registration: a Matplotlib figure, and a page on which the clouds can be turned and moved.

The page is one HTML file that needs no network; making it needs no further library. The figure needs the extra ``viz``.
"""

from urrt_jax.viewer.colors import region_colors
from urrt_jax.viewer.page import Page, save_page, show_registration
from urrt_jax.viewer.picture import plot_registration

__all__ = ["Page", "plot_registration", "region_colors", "save_page", "show_registration"]
