"""What `vulture` takes for unused and is not: one name a line, with the reason.

`tests/test_style.py` runs vulture with this file. It refuses an entry without a reason, and
an entry that is not needed any more.
"""

PlainMethod  # the entry of baselines/plain/method.toml
TrimmedMethod  # the entry of baselines/trimmed/method.toml
WildMethod  # the entry of baselines/wild/method.toml
JointPoseMethod  # the entry of baselines/joint-pose/method.toml
ExposureMethod  # the entry of baselines/exposure/method.toml
OccluderMethod  # the entry of baselines/occluder-splats/method.toml
ScanMethod  # the entry of baselines/scan-texture/method.toml
SpaceMethod  # the entry of baselines/texture-space/method.toml
ShadowMethod  # the entry of baselines/shadow-albedo/method.toml
ComplementaryMasksMethod  # the entry of baselines/complementary-masks/method.toml
DelayedMaskMethod  # the entry of baselines/delayed-mask/method.toml
ZeroMeanExposureMethod  # the entry of baselines/zero-mean-exposure/method.toml
write_splits  # writes what `read_splits` reads; benchmarks and organizers call it
OneShotMethod  # the entry of baselines/one-shot-prior/method.toml
_.ambient_rate  # `Recipe.rates` reads it by the tensor's name
_.betas_rate  # `Recipe.rates` reads it by the tensor's name
_.bias_rate  # `Recipe.rates` reads it by the tensor's name
_.displacement_rate  # `Recipe.rates` reads it by the tensor's name
_.parts_seen  # programs read it in the JSON of a fit
_.frame_rate  # `Recipe.rates` reads it by the tensor's name
_.gaussian_rate  # `Recipe.rates` reads it by the tensor's name
_.identity_rate  # `Recipe.rates` reads it by the tensor's name
_.lamp_rate  # `Recipe.rates` reads it by the tensor's name
_.latent_rate  # `Recipe.rates` reads it by the tensor's name
_.network_rate  # `Recipe.rates` reads it by the tensor's name
_.occluder_color_rate  # `Recipe.rates` reads it by the tensor's name
_.occluder_opacity_rate  # `Recipe.rates` reads it by the tensor's name
_.occluder_place_rate  # `Recipe.rates` reads it by the tensor's name
_.occluder_shape_rate  # `Recipe.rates` reads it by the tensor's name
_.pose_rate  # `Recipe.rates` reads it by the tensor's name
_.shadow_rate  # `Recipe.rates` reads it by the tensor's name
_.texture_rate  # `Recipe.rates` reads it by the tensor's name
_.transl_rate  # `Recipe.rates` reads it by the tensor's name
NetworkMethod  # the entry of baselines/network-scratch
modified  # part of the cache's key: a changed file is read again
_.maxlong  # reprlib reads it
_.maxother  # reprlib reads it
_.maxstring  # reprlib reads it
_.cache_path  # numba's dispatcher reads it
_.load_overload  # numba's dispatcher calls it
_.save_overload  # numba's dispatcher calls it
_.find_class  # pickle.Unpickler calls it
_.persistent_load  # pickle.Unpickler calls it
align  # pickles of numpy pass it
typecode  # pickles of numpy pass it
_._repr_markdown_  # notebooks call it
_._repr_mimebundle_  # notebooks call it
_.up_direction  # viser reads it
_.request_share_url  # viser's server calls it
verbose  # viser's server passes it
_.channelnames  # OpenImageIO reads it
_.camera_position  # pyvista reads it
_.view_angle  # pyvista reads it
_.gain_deviation  # the table CUES names it; getattr reads it
_.blur_deviation  # the table CUES names it; getattr reads it
_.misplacement_deviation  # the table CUES names it; getattr reads it
_.hidden_deviation  # the table CUES names it; getattr reads it
_.memo  # pickle.Unpickler reads it
REACH_X  # a row of the rasterizer's records, named for the order of the rows
_.thread_type  # the decoder reads how it may share its work
to_frame  # people call it in notebooks
