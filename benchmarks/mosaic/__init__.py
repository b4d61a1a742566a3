"""An entry for the Mosaic benchmark of differentiable solvers, and two domains proposed for it.

Mosaic (https://github.com/pasteurlabs/mosaic) calls every solver through two endpoints, ``apply``
and ``vector_jacobian_product``, in containers. Here the same endpoints run without containers:
``python -m benchmarks.mosaic``.
"""
