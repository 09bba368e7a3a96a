"""The 3D-URRT network: *3D Unsupervised Region-Aware Registration Transformer* (Hao and Fang), trained without labels.

One step of the network leads from two normalised clouds to a transform. Each part is a module:

1. **Describe** (``urrt_jax.features.moments``): numbers that describe what surrounds a point, the same from any pose.
2. **Encode** (``encoder``): an embedding of every point and, by max-pooling, one of the shape.
3. **Partition** (``partition``): n branches assign every point to a region. They are trained by occupancy alone,
   or, where regions are parts, by occupancy and agreement.
4. **Attend** (``attention``): the pooled features of the regions, with their centroids encoded, attend to each other.
5. **Decode** (``decoder``, ``landmarks``): each region has a decoder, which reads the region's features in both clouds
   and asks for eight landmarks in each cloud. A landmark is a weighted mean of all points; the weights compare where
   points lie and what surrounds them. Every point of either cloud is looked up in both clouds in the same way.
6. **Agree** (``consensus``): the transform on which the landmarks agree. One landmark in 17 proposes a hypothesis,
   together with all landmarks that keep their distances to it in both clouds. From the best hypothesis, twelve rounds
   give less and less weight to landmarks that disagree with the others.

``network`` applies steps 2 to 6 K = 3 times, each time to the source as moved so far; twice where refinement follows.
Clouds that lie on each other have the same landmarks, so the true pose is an exact fixed point of every step. The
numbers above are the defaults of ``ModelConfig``.

**Where the paper is silent, or cannot be followed literally**

- **Encoder.** The paper does not name it. Here it is PointNet's: a perceptron 36-64-64-128-128 of a point's place and
  its surroundings, with layer normalisation. There is no batch normalisation, which has a state and mixes pairs.
- **The embedding e in h_k([x, e]).** The paper does not say whether it is the point's or the shape's. Here it is the
  shape's, because occupancy is asked at points that are not in the cloud; the features of regions pool the points'
  embeddings. Only the direction of e is used, a unit vector: with its full length few regions stay in use.
- **Region and occupancy.** The paper takes the softmax of the branches as the region's score and its maximum as the
  occupancy. That maximum cannot fall below 1/n, so it cannot say "outside". Here the softmax gives the region, and the
  largest branch logit the occupancy, as in BAE-NET.
- **Regions that follow the pose.** Branches of [x, e] see where a point lies, so that a shape that is turned is cut in
  other places. With ``partition="parts"`` they see the invariants of what surrounds a point instead. A loss that the
  paper does not have (``losses.agreement``) keeps regions in use and alike in noisy samples. The packaged weights have
  the paper's branches.
- **How branches start.** The paper does not say. From random weights one branch soon won everywhere, and one region
  was left. Here each branch starts as a blob about an anchor of its own.
- **Inside and outside of a cloud without a surface.** Here *inside* is a shell: the places whose nearest point is
  closer than the cloud's own spacing. For closed meshes (``urrt train --queries``) voxels are filled from outside, and
  sampled as in IM-NET. The packaged weights used the shell.
- **Attention, eq. (2).** It sums α(f_i) over j. As printed the sum has no effect, because the softmax adds to 1. Here
  it sums α(f_j), and logits are divided by √d. The attended features are added to the region's own and normalised.
- **Decoders.** The paper does not say what φ_k is. Here a decoder places landmarks in both clouds, which are aligned in
  closed form over all regions with weights N_k/N, beside the places of looked-up points (``lookups=0`` leaves these
  out). Decoders that regress the pose are there, too: ``decoder="pose"``, six numbers for the rotation and three for
  the translation.
- **Fusion, φ = Σ (N_k/N) φ_k.** A sum of rotation matrices is no rotation. Here the moments of the landmarks are
  summed, or the nine numbers of the poses, and one rotation is made of the sum.
- **Empty regions.** The paper does not mention them. Here an empty region has no weight and is not attended to, and a
  region that one cloud lacks has no weight in the fusion.
- **Chamfer loss.** The paper does not say which clouds it compares. Here it compares the shapes before corruption, and
  the network sees the corrupted ones. No true pose is read, but training needs whole shapes.
- **Sizes and training.** Layers, widths, n, d, optimiser, epochs and the weight of the losses are not given. Here: one
  attention layer, n = 8, d = 128, eight landmarks a region, AdamW with a cosine from 1e-3, occupancy weight 0.02. The
  card of each model has all of them (``urrt_jax.model_card``).
- **Number of steps.** The paper applies the network once (``steps=1``). Here K = 3, without derivatives from one step
  to the one before.
"""

from urrt_jax.model.config import ModelConfig
from urrt_jax.model.network import Estimate, Model, estimate, init_model

__all__ = ["Estimate", "Model", "ModelConfig", "estimate", "init_model"]
