"""Classical peers: other people's methods, through their own libraries, behind one interface.

``PEERS`` names them all. A peer is a frozen configuration whose ``align_pair`` gives the (4, 4) matrix of one pair.
Its library is imported when it is used; the extra ``peers`` installs all but Go-ICP. Lengths are in units of the
shapes' bounding sphere; ``OnScans`` brings scans of any unit to it. The settings were chosen among a few on training
shapes: clean, independently sampled with noise, cropped and with outliers (``experiments/peer_settings``); those of ICP
from many starts were not.

Learned peers, the networks of other papers, are in ``urrt_jax.peers.learned``: their answers depend on weights, which
``urrt_jax.peers.learned.weights`` finds, and they take pairs in batches.
"""

from urrt_jax.peers.correspondences import FGR, RANSAC, KISSMatcher
from urrt_jax.peers.goicp import GoICP
from urrt_jax.peers.iterative import GICP, MultiStartICP, Open3DICP, PointToPlaneICP
from urrt_jax.peers.peer import Peer
from urrt_jax.peers.simple import Identity, PrincipalAxes
from urrt_jax.peers.then_icp import OnScans, ThenICP

PEERS: dict[str, Peer] = {
    "identity": Identity(),
    "principal_axes": PrincipalAxes(),
    "icp_identity": Open3DICP(start="identity", iterations=50),
    "icp": Open3DICP(),
    "icp_starts": MultiStartICP(),
    "icp_plane": PointToPlaneICP(),
    "gicp": GICP(),
    "fgr": FGR(),
    "fgr_icp": ThenICP(peer=FGR()),
    "ransac": RANSAC(),
    "ransac_icp": ThenICP(peer=RANSAC()),
    "kiss": KISSMatcher(),
    "goicp": GoICP(),
    "scan_icp": OnScans(peer=Open3DICP()),
    "scan_fgr": OnScans(peer=FGR()),
    "scan_ransac": OnScans(peer=RANSAC()),
    "scan_kiss": OnScans(peer=KISSMatcher(voxel=0.03)),
}
"""Every peer by its name, with the settings that our tables state."""

__all__ = [
    "FGR",
    "GICP",
    "PEERS",
    "RANSAC",
    "GoICP",
    "Identity",
    "KISSMatcher",
    "MultiStartICP",
    "OnScans",
    "Open3DICP",
    "Peer",
    "PointToPlaneICP",
    "PrincipalAxes",
    "ThenICP",
]  # fmt: skip
