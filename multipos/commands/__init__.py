"""The commands of ``multipos``, one module each: ``add_options(parser)`` and ``run(arguments)``."""
