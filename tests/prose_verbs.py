"""Verbs that a function's docstring may begin with, in the imperative."""

from __future__ import annotations

VERBS = frozenset(
    """
    abort accept accumulate activate adapt add adjust advance align allocate allow announce answer append apply
    approximate arrange assemble assert assign associate attach average await
    backproject backpropagate begin bind blend block bound build
    calibrate call cancel capture cast certify change check choose clamp classify clean clear clip clone close cluster
    collect color combine command compare compile complete compose composite compress compute concatenate configure
    confirm connect consume contract control convert convolve copy correct count cover create crop cut
    deactivate decide declare decode decompose decompress decrease define delay delete deliver densify derive describe
    deserialize detach detect determine discard disconnect display distort divide down downsample draw drain drive drop
    dump duplicate
    emit enable encode encrypt end enforce ensure enter enumerate erase escape estimate evaluate evict examine exchange
    exclude execute exit expand expect explain export express extend extract
    factor fail feed fetch fill filter find finish fit flag flatten flip flush fold follow forget format formulate
    forward free freeze fuse
    gather generate get give go grasp group grow guess guard
    halve handle hash hide hold
    identify ignore import include increase index infer initialize inject insert inspect install integrate interpolate
    interpret interrupt intersect invert invoke is iterate
    join
    keep
    label launch lay leave let lift limit linearize link list listen load localize lock log look lower
    make map mark marginalize mask match materialize maximize measure merge minimize mirror mix modify monitor move
    multiply
    name normalize note notify
    observe obtain offer open optimize order orient orthonormalize overlay
    pack pad paint pair parse partition pass pause perform permute pick place plan play plot point poll pop populate
    position post predict prefer prepare preserve press print process produce project propagate propose prove provide
    prune publish pull push put
    quantize query queue
    raise randomize rank rasterize read rebuild receive recompute recognize record reduce refine refuse register
    regrasp reject relax release relocalize remap remember remove rename render reorder repair repeat replace replan
    replay report request require resample rescale reserve reset resize resolve respond restore restart restrict resume
    retime retract retrieve retry return reverse revise rewrite rotate round route run
    sample saturate save scale scan scatter schedule score search seed segment select send separate serialize serve set
    shape shift shorten show shrink shut shuffle sign simulate sit sketch skip slice slow smooth solve sort spawn spend
    split spread square stack stamp start state stay steer step stop store stream stretch subscribe subtract sum
    summarize supply suppress sweep switch synchronize synthesize
    take tell test thin throw tile time toggle touch trace track train transform translate transpose traverse trim try
    tune turn
    undistort undo unfold unite unlock unpack unproject unregister unsubscribe unwrap update upload upsample use
    validate verify visit vote
    wait wake walk warm warn warp watch weigh weight widen withdraw work wrap write
    yield zero
    """.split()
)
