"""The installed JAX computes what the code says."""

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np


def test_vmapped_3x3_product_with_a_reduction_under_jit_agrees_with_eager():
    """jaxlib 0.10.2, 0.11.0 and 0.11.1 are wrong here on the CPU (jax-ml/jax#39103); pyproject.toml excludes them."""
    identity = jnp.eye(3)
    # 32,769 rows is one more than the CPU compiler handles in the loop that it gets right.
    rows = jnp.zeros((32_769, 3)).at[:, 0].set(jnp.arange(32_769.0))

    def squared_norms(points):
        return jax.vmap(lambda point: jnp.sum((identity @ point) ** 2))(points)

    np.testing.assert_allclose(
        jax.jit(squared_norms)(rows),
        squared_norms(rows),
        rtol=1e-6,
        err_msg=f"jaxlib {jaxlib.__version__} miscompiles this program, as 0.10.2, 0.11.0 and 0.11.1 do; "
        "install 0.10.1 (Python 3.11) or 0.11.2 and later (jax-ml/jax#39103)",
    )
