"""Any column described by others, in segments, with the terms that the data support.

Open `regression` first, which is what comes out. The front door is
`multipos.fitting.regress_columns`.
"""
