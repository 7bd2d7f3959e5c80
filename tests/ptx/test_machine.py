"""Programs for the machine, written by hand: what threads do together, and what it stops at."""

import re

import pytest
import torch
from torch import Tensor

from tests.ptx.machine import launch
from tests.ptx.memory import Fault

START = """
    mov.u32 %r1, %tid.x;
    mov.u32 %r2, %ctaid.x;
    ld.param.b64 %rd1, [k_param_0];
    mad.lo.s32 %r3, %r2, 32, %r1;
    mad.wide.u32 %rd2, %r3, 4, %rd1;
"""


def run(body: str, out: Tensor, blocks: int = 1, warps: int = 1, shared: int = 0) -> list:
    """What a kernel of one argument leaves there."""
    declared = ".reg .pred %p<9>; .reg .b32 %r<19>; .reg .b64 %rd<9>;".replace("; ", ";\n") + "\n"
    text = f".visible .entry k(.param .u64 k_param_0)\n{{\n{declared}{START}{body}\n ret;\n}}\n"
    launch(text, (blocks, 1, 1), warps, shared, [out])
    return out.tolist()


def ints(count: int) -> Tensor:
    return torch.zeros(count, dtype=torch.int32)


def test_threads_that_part_meet_where_their_ways_do_and_exchange():
    """The odd ones go out of the way to a place behind the one where all meet."""
    body = """
    and.b32 %r4, %r1, 1;
    setp.eq.s32 %p1, %r4, 1;
    mov.b32 %r5, 10;
    @%p1 bra $FAR;
$MEET:
    add.s32 %r5, %r5, %r1;
    shfl.sync.bfly.b32 %r6, %r5, 1, 31, -1;
    st.global.b32 [ %rd2 + 0 ], { %r6 };
    ret;
$FAR:
    mov.b32 %r5, 100;
    bra.uni $MEET;
    """
    assert run(body, ints(32))[:4] == [101, 10, 103, 12]


def test_a_loop_lasts_as_long_as_each_thread_wants():
    body = """
    mov.b32 %r5, 0;
$AGAIN:
    add.s32 %r5, %r5, 3;
    setp.lt.s32 %p1, %r5, %r1;
    @%p1 bra $AGAIN;
    redux.sync.max.s32 %r6, %r5, -1;
    sub.s32 %r6, %r6, %r5;
    st.global.b32 [ %rd2 + 0 ], { %r6 };
    """
    assert run(body, ints(32)) == [33 - max(3, -(-i // 3) * 3) for i in range(32)]


def test_a_block_has_its_own_shared_memory_and_waits_for_its_warps():
    body = """
    shl.b32 %r4, %r1, 2;
    mov.b32 %r5, global_smem;
    add.s32 %r5, %r5, %r4;
    add.s32 %r6, %r1, %r2;
    st.shared.b32 [%r5], %r6;
    bar.sync 0;
    xor.b32 %r4, %r4, 252;
    ld.shared.b32 %r7, [%r4];
    mad.lo.s32 %r3, %r2, 64, %r1;
    mad.wide.u32 %rd2, %r3, 4, %rd1;
    st.global.b32 [ %rd2 + 0 ], { %r7 };
    """
    expected = [63 - i for i in range(64)] + [64 - i for i in range(64)]
    assert run(body, ints(128), blocks=2, warps=2, shared=256) == expected


def test_sums_are_atomic_over_all_blocks():
    assert run("red.global.gpu.relaxed.add.s32 [ %rd1 + 0 ], %r1;", ints(1), blocks=3) == [3 * 31 * 16]


FAULTS = {
    "outside of every argument": "st.global.b32 [ %rd2 + 4 ], { %r1 };",
    "access that is not aligned": "st.global.b32 [ %rd1 + 2 ], { %r1 };",
    "different numbers to one place": "st.global.b32 [ %rd1 + 0 ], { %r1 };",
    "writes where another wrote": "mov.b32 %r1, 7;\n st.global.b32 [ %rd1 + 0 ], { %r1 };",
    "reads what another wrote": "st.global.b32 [ %rd2 + 0 ], { %r1 };\n ld.global.b32 { %r5 }, [ %rd1 + 0 ];",
    "writes what another read": "ld.global.b32 { %r5 }, [ %rd1 + 0 ];\n st.global.b32 [ %rd2 + 0 ], { %r1 };",
    "threads of a warp are missing": """
        setp.eq.s32 %p1, %r1, 3;
        @%p1 ret;
        shfl.sync.bfly.b32 %r6, %r1, 1, 31, -1;""",
    "threads of a block are missing": """
        setp.eq.s32 %p1, %r1, 3;
        @%p1 bra $ON;
        bar.sync 0;
        $ON:
        st.global.b32 [ %rd2 + 0 ], { %r1 };""",
    "outside of the block's shared memory": "st.shared.b32 [global_smem+8], %r1;",
    "not aligned to its width": "ld.global.v2.b32 { %r5, %r6 }, [ %rd1 + 4 ];",
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_fault_is_named_with_its_instruction(what):
    with pytest.raises(Fault, match=f"^k: .*{re.escape(what)}"):
        run(re.sub(r"^\s+\$", "$", FAULTS[what], flags=re.MULTILINE), ints(64), blocks=2)
    run("st.global.b32 [ %rd2 + 0 ], { %r1 };", ints(64), blocks=2)  # in another launch it is allowed
