"""The closed loop over a campaign: residual problems of its parts, the engine on each, the model update, the campaign again.

problems.py   which parts a campaign has, and the residual problem of each from its files
examine.py    the engine on one part, as a cached step
held_out.py   figures before and after on data that the fit has not seen
close.py      the Prefect flow, and loop.json
"""
