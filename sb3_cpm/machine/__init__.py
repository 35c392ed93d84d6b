"""
The machine and what it can do: what works, and a renderer where there is no GPU.

===================  ================================================================================
``doctor``           what works here, what does not, and the cure
``rendering``        whether SAPIEN can render; choosing the renderer of an environment
``vulkan``           software Vulkan in a private folder, used from within Python
``vulkan_install``   how it gets there
``thread_affinity``  the renderer's thread stays where its process works
``memory``           how much there is
===================  ================================================================================

Nothing is imported here: ``doctor`` has to work where torch and ManiSkill do not.
"""
