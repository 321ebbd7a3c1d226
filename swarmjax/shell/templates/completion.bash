# Completes the words of swarmjax in bash. Written by: swarmjax --completion bash

_swarmjax_commands='@COMMANDS@'

_swarmjax_table='@TABLE@'

# Offers $2 if it begins with $1.
_swarmjax_offer() {
    [[ $2 == "$1"* ]] && COMPREPLY+=("$2")
}

# Offers the next part, up to the next dot, of each key of command $1 that begins with $2.
_swarmjax_keys() {
    local command key rest part
    while read -r command key rest; do
        [[ $command == "$1" && $key == "$2"* ]] || continue
        rest=${key#"$2"}
        part=$2${rest%%.*}
        [[ $rest == *.* ]] && part+=. || part+==
        # Offer each part once. A section can also be a key, so equal parts need not be adjacent.
        [[ " ${COMPREPLY[*]} " == *" $part "* ]] || COMPREPLY+=("$part")
    done <<<"$_swarmjax_table"
    compopt -o nospace 2>/dev/null
}

# Offers the values of key $2 of command $1 that begin with $3.
_swarmjax_values() {
    local command key values value file
    while read -r command key values; do
        [[ $command == "$1" && $key == "$2" ]] || continue
        for value in $values; do
            if [[ $value == @file ]]; then
                compopt -o filenames 2>/dev/null
                while IFS= read -r file; do COMPREPLY+=("$file"); done < <(compgen -f -- "$3")
            else
                _swarmjax_offer "$3" "$value"
            fi
        done
    done <<<"$_swarmjax_table"
}

_swarmjax() {
    local line=${COMP_LINE:0:COMP_POINT} word name rest index
    COMPREPLY=()
    word=${line##*[[:space:]]}
    if ((COMP_CWORD == 1)); then
        while read -r name rest; do
            _swarmjax_offer "$word" "$name"
        done <<<"$_swarmjax_commands"
        for name in --help --version --completion; do
            [[ -n $word ]] && _swarmjax_offer "$word" "$name"
        done
    elif [[ ${COMP_WORDS[1]} == --completion ]]; then
        for name in bash zsh fish; do _swarmjax_offer "$word" "$name"; done
    elif [[ $word == -* ]]; then
        _swarmjax_offer "$word" --help
    elif [[ $word == *=* ]]; then
        _swarmjax_values "${COMP_WORDS[1]}" "${word%%=*}" "${word#*=}"
        # By default, bash splits words at = and replaces only the text after it.
        [[ $COMP_WORDBREAKS == *=* ]] && return
        for index in "${!COMPREPLY[@]}"; do
            COMPREPLY[index]=${word%%=*}=${COMPREPLY[index]}
        done
    else
        _swarmjax_keys "${COMP_WORDS[1]}" "$word"
    fi
}

complete -F _swarmjax swarmjax
