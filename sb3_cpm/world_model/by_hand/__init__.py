"""
Gradients by hand, for the loops over many small steps in which autograd's own bookkeeping takes longer than the arithmetic.
Each is equal to autograd's to rounding, which the tests hold against it.

===========  ==========================================================
``scan``     the RSSM along a sequence
``dream``    what an actor does in imagination
``returns``  MLPs, and the lambda-returns of what was imagined
===========  ==========================================================
"""
