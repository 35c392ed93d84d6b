"""
What makes the world model as fast as the machine allows. Every part computes what PyTorch's own would, and steps back for it
where it cannot be used or would not pay; none knows what it is used for.

=================  ========================================================================
``acceleration``   the switches ``amp`` and ``compile``; where plain float32 on a CPU is at work
``linear``         dense layers by oneDNN where that is faster than MKL
``one_hot``        products of one-hot vectors, which are look-ups
``activation``     ELU and tanh in place, with their gradients
``deconvolution``  transposed convolutions as products
``cuda_graphs``    whole updates launched at once on a GPU
=================  ========================================================================
"""
