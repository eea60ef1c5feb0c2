"""Machine code for the functions that Python or C calls, and for no others.

numba links each function with all that it calls, optimises the whole and makes machine code of it,
and does so again for each of its callers. A tick has hundreds of small functions that all become
part of one loop, so LLVM would work on each as often as there are callers above it. Here it works
on a function once, as a part of the one that Python or C calls: the first run of an installation
compiles in less than half the time, and computes the same bits.

``Deferring`` is numba's compiler up to that point, ``UnlinkedCode`` is what is still to do,
``KeptResult`` writes both to numba's cache, and ``DeferredDispatcher`` is what a decorator makes of
a function.
"""

from __future__ import annotations

import hashlib
from functools import cache, cached_property
from typing import Any

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, Flags
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.funcdesc import default_mangler
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.sigutils import normalize_signature
from numba.core.typed_passes import NativeLowering
from numba.core.types import Boolean, Function, Number, unliteral
from numba.core.typing.context import Context

from gfm_runtime.garbage import garbage_kept


class _Library(JITCodeLibrary):
    """The code of a function, linked with its callees when someone asks for an address."""

    _alone: Any = None
    exported: frozenset[str] = frozenset()  # callees that have an address

    @classmethod
    def of(cls, name: str) -> _Library:
        library = cls(cpu_target.target_context.codegen(), name)
        library.enable_object_caching()
        return library

    def add_linking_library(self, library: Any) -> None:
        """Add a callee, which numba would compile first."""
        self._linking_libraries.append(library)

    def _get_module_for_linking(self) -> Any:
        """The function alone, before it is optimised with its callees."""
        if self._finalized:
            return super()._get_module_for_linking()
        if self._alone is None:
            self._alone = self._final_module.clone()
            for function in self._alone.functions:
                if not function.is_declaration and function.linkage == llvm.Linkage.external:
                    function.linkage = "linkonce_odr"  # several that are linked may contain it
        return self._alone

    def _callees(self) -> list[Any]:
        """What the function calls, itself or through others."""
        callees: dict[Any, None] = {}
        left = list(self._linking_libraries)
        while left:
            library = left.pop()
            if library not in callees:
                callees[library] = None
                if isinstance(library, _Library):
                    left += library._linking_libraries
        return list(callees)

    def _link(self, module: Any) -> None:
        """Link the callees into a module that has the function.

        LLVM takes from a library what the module calls at that moment, so a library is linked
        again when one that came after it calls more.
        """
        homes = {
            function.name: library
            for library in self._callees()
            for function in library._get_module_for_linking().functions
            if not function.is_declaration
        }
        while missing := {
            homes[function.name]: None
            for function in module.functions
            if function.is_declaration and function.name in homes
        }:
            for library in missing:
                module.link_in(library._get_module_for_linking(), preserve=True)

    @property
    def has_dynamic_globals(self) -> bool:
        """Whether the code holds addresses of this process; numba would compile it to say so."""
        if self._finalized:
            return bool(super().has_dynamic_globals)
        return any(
            variable.name.startswith("numba.dynamic.globals")
            for library in (self, *self._callees())
            for variable in library._final_module.global_variables
        )

    def finalize(self) -> None:
        """Optimise the function with its callees, and make machine code of it."""
        for library in self._callees():
            self._reload_init.update(library._reload_init)
        own = {f.name for f in self._final_module.functions if not f.is_declaration}
        for_c = {name for name in own if name.startswith("cfunc.")}
        whose = hashlib.sha256(repr(sorted(own)).encode()).hexdigest()[:16]
        self._link(self._final_module)
        for function in self._final_module.functions:
            # nobody else calls a callee: LLVM leaves out the arguments that it does not use, which
            # are most of the words of a plant
            has_address = function.name in (for_c or own | self.exported)
            if not (has_address or function.is_declaration):
                function.linkage = llvm.Linkage.internal
                function.name += f".{whose}"  # the linker of a process takes the first of a name
        self._linking_libraries = []
        super().finalize()

    def pack(self) -> tuple[str, bytes]:
        """The name, and the function with its callees, before they are optimised."""
        module = self._final_module.clone()
        self._link(module)
        return self.name, module.as_bitcode()

    @classmethod
    def unpack(cls, packed: tuple[str, bytes]) -> _Library:
        """What ``pack`` made, in another process."""
        name, bitcode = packed
        library = cls.of(name)
        library._final_module.link_in(llvm.parse_bitcode(bitcode))
        return library


def _mangler(name: str, arguments: tuple[Any, ...], **rest: Any) -> str:
    """The name of a function for LLVM, with a digest of its arguments' types.

    numba writes out the types. Those of our records have hundreds of fields, and each call would
    have 20,000 characters. It also names a record by a number that counts the types of the process:
    two sizes of plants, compiled by two processes, could have one name, and a third process that
    loads both would call either for both.
    """
    digest = hashlib.sha256(repr(arguments).encode()).hexdigest()[:16]
    return str(default_mangler(f"{name}.{digest}", (), **rest))


class UnlinkedCode:
    """What Python will call, once it is made; ``nrt``: the function uses numba's runtime."""

    def __init__(self, library: Any, fndesc: Any, env: Any, nrt: bool) -> None:
        self.library, self.fndesc, self.env, self.nrt = library, fndesc, env, nrt
        self.function: Any = None
        self.linkable = True  # not what a wheel carries, which is machine code alone

    def make(self) -> None:
        """Make the machine code, with a function that takes the arguments from Python."""
        cpu_target.target_context.refresh()  # what is only loaded does without, see `compiled`
        context = cpu_target.target_context.subtarget(enable_nrt=self.nrt)
        library = _Library.of(self.library.name)  # a caller without this compiler may have its own
        library.add_linking_library(self.library)
        library.exported = frozenset({self.fndesc.llvm_func_name})
        context.create_cpython_wrapper(library, self.fndesc, self.env, None, release_gil=True)
        self.function = context.get_executable(library, self.fndesc, self.env)
        self.library = library


class KeptResult(CompileResultCacheImpl):
    """A function in numba's cache, with machine code or without."""

    def reduce(self, cres: Any) -> Any:
        """As numba asks for it to write a function; those for C have no entry."""
        entry = cres.entry_point
        if entry is None or entry.function is not None:
            return None, super().reduce(cres._replace(library=entry.library) if entry else cres)
        # nor does numba keep these
        cres.fndesc.typemap = cres.fndesc.calltypes = None
        made_of = entry.library.pack(), entry.fndesc, entry.env, entry.nrt
        return made_of, (cres.signature, cres.reload_init)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """As numba asks for it to read a function."""
        made_of, rest = payload
        if made_of is None:
            cres = super().rebuild(target_context, rest)
            entry = UnlinkedCode(cres.library, cres.fndesc, cres.environment, nrt=False)
            entry.function = cres.entry_point
            return cres._replace(entry_point=entry)
        packed, fndesc, env, nrt = made_of
        signature, reload_init = rest
        for function in reload_init:
            function()
        library = _Library.unpack(packed)
        result: Any = CompileResult
        return result(
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=library,
            environment=env,
            entry_point=UnlinkedCode(library, fndesc, env, nrt),
            fndesc=fndesc,
            type_annotation="",
            signature=signature,
            objectmode=False,
            lifted=(),
            typing_error=None,
            call_helper=None,
            metadata=None,
            reload_init=reload_init,
            referenced_envs=(),
        )


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    """numba's last step, without machine code."""

    def run_pass(self, state: Any) -> bool:
        flags, context = state.flags, state.targetctx
        library = state.library = _Library.of(state.func_id.func_qualname)
        called_by_c = flags.no_compile
        flags.no_compile = True
        if not called_by_c:
            flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        state.targetctx = context.subtarget(mangler=_mangler)
        super().run_pass(state)
        state.targetctx = context
        if not called_by_c:
            lowered = state["cr"]
            entry = UnlinkedCode(library, lowered.fndesc, lowered.env, flags.nrt)
            context.insert_user_function(entry, lowered.fndesc, [library])
            state.reload_init.extend(library._reload_init)
            state["cr"] = lowered._replace(cfunc=entry)
        return True


class _Flags(Flags):
    """numba's options of a compilation, which it compares at every call that it types."""

    _defaults = Flags().values()

    def values(self) -> dict[str, Any]:
        """All values by their names."""
        return {**self._defaults, **self._values}


class _Arguments(tuple[Any, ...]):
    """Types of arguments, which numba writes out for each step of a compilation."""

    @cached_property
    def _written(self) -> str:
        return super().__repr__()

    def __repr__(self) -> str:
        return self._written


class _Typing(Context):
    """numba's typing of calls, which remembers those of operators on numbers.

    ``a * b`` may be of arrays, strings, dates and much else, and numba tries one after the other
    at every place that multiplies."""

    def __init__(self, context: Any) -> None:
        self.__dict__ = context.__dict__

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """As numba asks for it at each call that it types."""
        kind = self._lookup_global(func) or func
        if type(kind) is not Function or kws or not all(isinstance(a, _NUMBERS) for a in args):
            return super().resolve_function_type(func, args, kws)
        known = _signatures.get((kind, args))
        if known is None:
            known = _signatures[kind, args] = super().resolve_function_type(func, args, kws)
        return known


_NUMBERS = Number, Boolean
_signatures: dict[Any, Any] = {}
_typing = cache(_Typing)


class Deferring(Compiler):
    """numba's compiler, up to the machine code."""

    def __init__(self, typing: Any, *args: Any) -> None:
        super().__init__(_typing(typing), *args)
        self.state.flags = _Flags(self.state.flags)
        self.state.args = _Arguments(self.state.args)

    def compile_extra(self, func: Any) -> Any:
        """As numba asks for it; those of callees are compiled in the course of it."""
        with garbage_kept():
            return super().compile_extra(func)

    def define_pipelines(self) -> Any:
        """As numba asks for it, once a compilation."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [
                (_Lowering if step is NativeLowering else step, why)
                for step, why in pipeline.passes
            ]
            pipeline.finalize()
        return pipelines


class DeferredDispatcher(CPUDispatcher):
    """A compiled function; it has machine code for the arguments that Python has called it with."""

    _inside = False  # numba compiles a caller
    _insert: Any  # numba's, in C
    _cache: Any
    _replaced: tuple[Any, ...] = ()  # Python goes on to call them

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """As numba asks for it where a function that it compiles calls this one.

        numba would compile it anew for each number that someone passes: to it, 0 is a type."""
        args = tuple(map(unliteral, args))
        with global_compiler_lock:
            before, self._inside = self._inside, True
            try:
                return super().get_call_template(args, kws)
            finally:
                self._inside = before

    def add_overload(self, cres: Any) -> None:
        """Take what was compiled for a signature; Python finds it if it has machine code."""
        args = tuple(cres.signature.args)
        self.overloads[args] = cres
        if cres.entry_point.function is not None:
            self._insert([arg._code for arg in args], cres.entry_point.function, False)

    def compile(self, sig: Any) -> Any:
        """Compile for a signature, with machine code unless a compiled function asks."""
        with global_compiler_lock:
            inside = self._cache.links = self._inside
            args, _ = normalize_signature(sig)
            found: Any = self.overloads.get(tuple(args))
            if inside and found is not None and not found.entry_point.linkable:
                self._replaced += (self.overloads.pop(tuple(args)),)
            entry: Any = super().compile(sig)
            if inside:
                return entry
            if entry.function is None:
                cres = self.overloads[tuple(args)]
                entry.make()
                self.add_overload(cres)
                self._cache.save_overload(sig, cres)
            return entry.function
