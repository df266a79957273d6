"""The simulator's truth: a flight, its sensors and its scene, from physics alone.

It shares geodesy and rotations with the rest of the package and nothing else: a simulator that used the pipeline's
camera, interferometer or mechanisation could not find a mistake in them.

Modules
-------
effects         what the truth may hold that no declaration mentions
streams         one independent random stream a purpose
harmonics       band-limited random processes with exact derivatives
flight          position and attitude at any time
inertial        what an inertial unit measures
thermal         temperatures in and around the sensors, and the biases they cause
gnss            what a GNSS receiver measures
materials       spectra: reflectance, illumination, response
world           terrain and scene
lens            pixel ↔ ray
interferometer  spectrum → interferogram on the detector
imaging         pose, scene, interferogram → frames
"""
