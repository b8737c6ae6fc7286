"""Drivers that ask a language or vision-language model.

`language` makes one for a model behind a chat server. It is known by this name in files and on the command
line.
"""

from limsim_jax.policies.language.answers import CallStatus as CallStatus
from limsim_jax.policies.language.describe import STYLES as STYLES
from limsim_jax.policies.language.describe import Style as Style
from limsim_jax.policies.language.driver import LanguageDriver as LanguageDriver
from limsim_jax.policies.language.driver import language as language
from limsim_jax.policies.language.memory import read_memories as read_memories
from limsim_jax.policies.language.memory import write_memories as write_memories
from limsim_jax.policies.language.rules import RuleTable as RuleTable
from limsim_jax.policies.language.store import answer_table as answer_table
from limsim_jax.policies.language.store import read_answers as read_answers
from limsim_jax.policies.language.store import shares as shares
